"""``python -m noiseflow``: the command line."""

import sys
from pathlib import Path

# Python searches the working directory first; a user's folder named `recon` would hide this package's
if not sys.flags.safe_path and Path(sys.path[0]).resolve() != Path(__file__).resolve().parents[1]:
    del sys.path[0]

from noiseflow.commands.cli import main

main()
