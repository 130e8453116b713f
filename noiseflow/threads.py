"""The threads of this process: how they wait for each other, and computations on fewer of them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

PASSIVE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}
"""Environment variables with which idle OpenMP threads of GNU's and LLVM's libraries sleep instead of occupying a core.

Spinning threads take turns with the threads they wait for if other processes compute too: a fit of a noise model is then ten
times slower.
"""

# torch divides element-wise operations among threads from this number of elements on; a few functions that it divides earlier
# gain nothing: a spline flow on 4096 pixels takes as long on one thread as on two that have the cores to themselves
_SMALL = 2**15


def wait_passively() -> None:
    """Set `PASSIVE` for this process and its children, unless the user chose a policy; effective before torch is imported."""
    if not waiting():
        os.environ.update(PASSIVE)


def warn_if_spinning() -> None:
    """Warn if threads spin while they wait, and other processes need the cores."""
    import torch

    if torch.get_num_threads() == 1 or waiting() or not hasattr(os, "getloadavg"):
        return
    # this process alone causes a load of at most the number of cores
    if os.getloadavg()[0] > (os.cpu_count() or 1) + 1:
        warnings.warn(
            "other processes use the cores of this machine, and idle threads of this process occupy them too, which can make it "
            "ten times slower; set OMP_WAIT_POLICY=PASSIVE before Python starts, or call torch.set_num_threads(1)",
            RuntimeWarning,
            stacklevel=3,
        )


@contextmanager
def num_threads(count: int) -> Iterator[None]:
    """Compute on `count` threads within the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def few_threads(size: int) -> AbstractContextManager[None]:
    """Compute on one thread within the block if its operations have no more than `_SMALL` elements.

    Args:
        size: number of elements of the operations of the block.
    """
    return num_threads(1) if size <= _SMALL else nullcontext()


def waiting() -> str:
    """The setting that decides how idle threads wait; "" if there is none, and they spin."""
    return next((f"{name}={os.environ[name]}" for name in PASSIVE if name in os.environ), "")
