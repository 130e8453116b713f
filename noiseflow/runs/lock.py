"""Lock files: one run at a time per output. The system releases the lock if its process ends."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from noiseflow.runs.partials import link_target

# The file system does not support locks: runs go on without one.
_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)


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
    lock = FileLock(
        path, timeout=0, is_singleton=True, on_acquired=_sign
    )  # a singleton of each thread counts its blocks
    try:
        _take(lock, output)
        yield
    finally:  # a signal may have come while the lock was taken
        if lock.lock_counter <= 1 and (lock.is_locked or _is_free(lock)):
            # removed while the lock is held: other processes notice that the file they lock is gone
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        lock.release()


def _take(lock: BaseFileLock, output: str | Path) -> None:
    try:
        lock.acquire()
    except Timeout:
        raise BlockingIOError(
            f"{output} is being written by {_holder(lock_file(output))}; wait until it finishes, stop it, or name another output"
        ) from None
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


def _is_free(lock: BaseFileLock) -> bool:
    """Take the lock if no other run holds it; true where locks are not supported."""
    try:
        lock.acquire()
    except Timeout:
        return False
    except OSError:
        return True
    return True


def lock_file(output: str | Path) -> Path:
    """The lock file of an output, next to the file that is written (the target of a link)."""
    path = link_target(output).absolute()
    return path.with_name(f".{path.name}.lock")


def _sign(handle: int) -> None:
    """Write into the lock file who holds it."""
    os.ftruncate(handle, 0)
    holder = {"process": os.getpid(), "host": platform.node(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
    os.write(handle, json.dumps(holder).encode())


def _holder(path: Path) -> str:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        return f"process {int(told['process'])} on {told['host']} since {told['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
