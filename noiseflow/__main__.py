"""``python -m noiseflow``: the command line."""

from noiseflow.commands.cli import main

main()
