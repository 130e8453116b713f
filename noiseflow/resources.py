"""Threads and memory of this process: how idle threads wait, computations on fewer threads, and reuse of freed memory."""

import ctypes
import os
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

PASSIVE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "2000", "KMP_BLOCKTIME": "0"}
"""Environment variables with which idle OpenMP threads of GNU's and LLVM's libraries soon sleep instead of occupying a core.

Spinning threads take turns with the threads they wait for if other processes compute too: a fit of a noise model is then ten
times slower. Threads that sleep at once take long to wake on a virtual machine. A reconstruction of 64³ on two cores, idle and
beside two busy processes: 21 and 30 s without any spinning, 15 and 31 s with 2000 turns, 14 and 60 s with 20 000.
"""

# numpy's and scipy's linear algebra, which solves small dense problems here, has threads of its own, which spin too: with two of
# them a reconstruction of 64³ took 2.1 times the processor time beside other processes (docs/benchmarks/joint.md, "beside")
_ONE_BLAS = {"OPENBLAS_NUM_THREADS": "1"}
SHARING = PASSIVE | _ONE_BLAS
"""Environment variables of a process that shares its cores with others."""

_said: list[str] = []  # warnings that are not repeated


def wait_passively() -> None:
    """Set `SHARING` for this process and its children, unless the user chose otherwise; effective before numpy is imported."""
    if not waiting():
        os.environ.update(PASSIVE)
    for name, value in _ONE_BLAS.items():
        os.environ.setdefault(name, value)


def warn_if_spinning() -> None:
    """Warn, once in a process, if threads spin while they wait, and other processes need the cores."""
    import torch

    if _said or torch.get_num_threads() == 1 or waiting() or not hasattr(os, "getloadavg"):
        return
    # this process alone causes a load of at most the number of cores
    if os.getloadavg()[0] > (os.cpu_count() or 1) + 1:
        _said.append("threads spin")
        warnings.warn(
            "other processes use the cores of this machine, and idle threads of this process occupy them too, which can make it "
            "ten times slower; set OMP_WAIT_POLICY=PASSIVE and OPENBLAS_NUM_THREADS=1 before Python starts, or call "
            "torch.set_num_threads(1)",
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


def few_threads(size: int, *, small: int = 2**15) -> AbstractContextManager[None]:
    """Compute on one thread within the block if its operations are small: torch divides element-wise ones among threads from this
    number of elements on. A few functions that it divides earlier gain nothing: a spline flow on 4096 pixels takes as long on one
    thread as on two that have the cores to themselves."""
    return num_threads(1) if size <= small else nullcontext()


def waiting() -> str:
    """The setting that decides how idle threads wait; "" if there is none, and they spin."""
    return next((f"{name}={os.environ[name]}" for name in PASSIVE if name in os.environ), "")


# parameters of mallopt (malloc.h): M_MMAP_MAX (-4) arrays are mapped separately; M_TRIM_THRESHOLD (-1) bytes at the end are kept
_KEEPING = {-4: 0, -1: -1}
# as before: 32 MiB is the largest M_MMAP_THRESHOLD (-3) that glibc sets by itself, with twice as much at the end
_USUAL = {-4: 65536, -3: 32 * 2**20, -1: 64 * 2**20}
_blocks: list[None] = []  # that keep memory, one in the other


@contextmanager
def kept_memory() -> Iterator[None]:
    """Let glibc reuse the memory of large freed arrays within the block; no effect on other systems.

    By default glibc maps every array above 32 MiB separately and releases it at once. The system then clears the pages of each
    new array, which takes longer than most operations. The memory is released at the end of the block.
    """
    if not _blocks:
        _set(_KEEPING)
    _blocks.append(None)
    try:
        yield
    finally:
        _blocks.pop()
        if not _blocks:
            _set(_USUAL)
            hand_back()


def hand_back() -> None:
    """Release the memory held by `kept_memory`, before a computation with arrays of other sizes."""
    if libc := _glibc():
        libc.malloc_trim(0)


def _set(values: dict[int, int]) -> None:
    if libc := _glibc():
        for parameter, value in values.items():
            libc.mallopt(parameter, value)


def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return None
    return libc if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim") else None
