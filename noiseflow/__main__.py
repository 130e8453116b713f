"""``python -m noiseflow``: the command line."""

import sys
from pathlib import Path

# Python looks in the working directory first, where a user's folder `recon` would hide ours
if not sys.flags.safe_path and Path(sys.path[0]).resolve() != Path(__file__).resolve().parents[1]:
    del sys.path[0]

from noiseflow.commands.cli import main

main()
