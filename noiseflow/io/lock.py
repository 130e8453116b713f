"""Lock files: one run at a time per output. The system releases the lock if its process ends."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from noiseflow.io.partials import link_target

_HELD: set[tuple[str, int]] = set()
"""(lock file, thread) of the locks that this process holds."""
_UNKNOWN = "another process"


@contextlib.contextmanager
def locked(output: str | Path) -> Iterator[None]:
    """Hold the lock of an output within the block. Nested blocks of the same thread are allowed.

    The lock is the file ``.NAME.lock`` next to the output, which is removed at the end of the block. A file left by a killed run
    does not block others.

    Raises:
        BlockingIOError: another run holds the lock; the message names its process and host.
        OSError: the lock file cannot be created.
    """
    path = lock_file(output)
    key = str(path), threading.get_ident()
    if key not in _HELD:
        with _acquired(path, output):
            _HELD.add(key)
            try:
                yield
            finally:
                _HELD.discard(key)
    else:
        yield


def lock_file(output: str | Path) -> Path:
    """The lock file of an output, next to the file that is written (the target of a link)."""
    path = link_target(output).absolute()
    return path.with_name(f".{path.name}.lock")


@contextlib.contextmanager
def _acquired(path: Path, output: str | Path) -> Iterator[None]:
    handle = _open_and_lock(path, output)
    try:
        os.ftruncate(handle, 0)
        holder = {"process": os.getpid(), "host": platform.node(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        os.write(handle, json.dumps(holder).encode())
        yield
    finally:
        if os.name != "nt":  # removed while the lock is held, so that no other process can have locked this file
            path.unlink(missing_ok=True)
        os.close(handle)
        with contextlib.suppress(OSError):
            if os.name == "nt":
                path.unlink(missing_ok=True)


def _open_and_lock(path: Path, output: str | Path) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _try_lock(handle):
                raise BlockingIOError(
                    f"{output} is being written by {_holder(path)}; wait until it finishes, stop it, or name another output"
                )
            with contextlib.suppress(FileNotFoundError):
                if os.fstat(handle).st_ino == path.stat().st_ino:  # otherwise its last holder has just removed it
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _try_lock(handle: int) -> bool:
    try:
        if os.name == "nt":
            import msvcrt

            os.lseek(handle, 2**30, os.SEEK_SET)  # beyond the text, which other processes must be able to read
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
            os.lseek(handle, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # the file system does not support locks: run without one
        return error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
    return True


def _holder(path: Path) -> str:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        return f"process {int(told['process'])} on {told['host']} since {told['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return _UNKNOWN
