"""``python -m noiseflow``: the command line."""

from noiseflow.cli import main

main()
