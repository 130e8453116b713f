"""The command `noiseflow benchmark` of a checkout: the folder `benchmarks` is not part of the installed package."""

import sys
from collections.abc import Callable
from pathlib import Path

from noiseflow.installation import checkout


def command(root: Path | None) -> Callable[..., None]:
    """The command of a source tree, or outside one, of an installed package, a command that says where to find it."""
    if root is not None:
        if str(root) not in sys.path:
            sys.path.append(str(root))
        from benchmarks.command import benchmark

        return benchmark

    def elsewhere() -> None:
        """Measure run time against error of every method, in a checkout of the source tree."""
        raise FileNotFoundError(
            "benchmarks are part of noiseflow's source tree, not of the installed package: clone its repository, "
            "run `pip install --editable .` there, and start `noiseflow benchmark` again"
        )

    return elsewhere


benchmark = command(checkout())
