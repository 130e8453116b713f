"""Reuse of freed memory for large arrays during long computations."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # malloc.h
_NEVER, _NONE, _MOST = -1, 0, 65536
_LARGE = 32 * 2**20  # bytes; the largest threshold that glibc sets by itself
_depth = 0


@contextmanager
def kept_memory() -> Iterator[None]:
    """Let glibc reuse the memory of large freed arrays within the block; no effect on other systems.

    By default glibc maps every array above 32 MiB separately and releases it at once. The system then clears the pages of each
    new array, which takes longer than most operations. The memory is released at the end of the block.
    """
    global _depth
    if _depth == 0 and (libc := _glibc()):
        libc.mallopt(_MMAP_MAX, _NONE)
        libc.mallopt(_TRIM_THRESHOLD, _NEVER)
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        if _depth == 0 and (libc := _glibc()):
            libc.mallopt(_MMAP_MAX, _MOST)
            libc.mallopt(_MMAP_THRESHOLD, _LARGE)
            libc.mallopt(_TRIM_THRESHOLD, 2 * _LARGE)
            libc.malloc_trim(0)


def hand_back() -> None:
    """Release the memory held by `kept_memory`, before a computation with arrays of other sizes."""
    if libc := _glibc():
        libc.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return None
    return libc if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim") else None
