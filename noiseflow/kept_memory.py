"""Freed memory kept for the next array of its size, while something long runs."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # malloc.h
_NEVER, _NONE, _MOST = -1, 0, 65536
_LARGE = 32 * 2**20  # bytes; the most that glibc itself lets its threshold grow to
_depth = 0


@contextmanager
def kept_memory() -> Iterator[None]:
    """Let glibc reuse large arrays that have been freed; elsewhere, do nothing.

    By default it maps every array above 32 MiB anew, and hands it back at once. Then each operation on such an array begins with
    the system clearing its pages one by one, which takes longer than most operations. What was kept is handed back at the end.
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
    """Give the system what is kept so far, within `kept_memory`: what follows wants arrays of other sizes."""
    if libc := _glibc():
        libc.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return None
    return libc if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim") else None
