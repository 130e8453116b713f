"""`python -m benchmarks` in a checkout is `noiseflow benchmark`."""

import sys

from noiseflow.commands.cli import main

sys.argv.insert(1, "benchmark")
main()
