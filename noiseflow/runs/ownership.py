"""Who may write an output: its lock, which one run holds at a time, the mark of this program, and its temporary folders.

Files without the mark are not overwritten without `--overwrite`.

The mark is the last label of an MRC header, the ``Software`` tag of a TIFF file, ``_creator`` in the attributes of a Zarr group,
the format name in a safetensors file, ``Software`` in a PNG file, ``generator`` in a page, and the first line of a table and of
options; the table of a batch is known by its columns. An ``.npy`` header has no room for text: ours is padded to 1024 bytes,
which every reader skips and no other program writes. Angle files belong to the stack next to them.

Names of temporary folders identify the process, so that leftovers of killed runs can be removed.
"""

import contextlib
import errno
import functools
import json
import os
import platform
import re
import secrets
import shutil
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout

from noiseflow.installation import library_version

MARK = "noiseflow"
NPY_HEADER_BYTES = 1024
_BATCH_COLUMNS = b"series,volume,status,verdict,reason,error,"


def signature() -> str:
    """The mark with the version, such as ``noiseflow 0.1.0``."""
    return f"{MARK} {library_version()}"


def require_own(path: Path, *, overwrite: bool) -> None:
    """Check that an output does not replace a file that this program did not write. Raises FileExistsError if the file exists
    and this program did not write it.

    Args:
        path: an output; missing and empty files are accepted.
        overwrite: accept any file.
    """
    # existence is checked last, in case the file is deleted in the meantime
    if not overwrite and not is_own(path) and path.exists():
        raise FileExistsError(f"{path} was not written by noiseflow; name another output, or give --overwrite")


def is_own(path: Path) -> bool:
    """Whether a file or Zarr folder carries the mark of this program, or is an empty file."""
    from noiseflow.io.image_file import MRC_SUFFIXES, TIFF_SUFFIXES

    kind = path.suffix.lower()
    try:
        if path.is_dir():
            known = json.loads((path / "zarr.json").read_text(encoding="utf-8")) if kind == ".zarr" else {}
            return str(known["attributes"]["_creator"]["name"]) == MARK
        if path.stat().st_size == 0:
            return True
        if kind in (".rawtlt", ".tlt"):
            return (stack := path.with_suffix(".mrc")).is_file() and is_own(stack)
        if kind in TIFF_SUFFIXES:
            import tifffile

            with tifffile.TiffFile(path) as tiff:
                tags: Any = tiff.pages.first.tags
                return str(tags["Software"].value).startswith(MARK)
        if kind == ".safetensors":
            return (tensors_format(path) or "").startswith(MARK)
        with path.open("rb") as stream:
            head = stream.read(1024)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return False
    if kind in MRC_SUFFIXES:
        first, size = 224, 80  # of the labels, whose number precedes them
        last = first + size * (int.from_bytes(head[first - 4 : first], "little") - 1)
        return head[last : last + size].startswith(MARK.encode())
    if kind in (".csv", ".toml"):
        return head.startswith((f"# {MARK} ".encode(), _BATCH_COLUMNS))
    if kind == ".npy":
        return head.startswith(npy_start())
    marks = {".png": "tEXtSoftware\0", ".json": '"written_by": "', ".html": 'name="generator" content="'}
    return kind in marks and f"{marks[kind]}{MARK}".encode() in head


def npy_start() -> bytes:
    """The first bytes of our ``.npy`` files: magic string, version 1.0 and header length."""
    return b"\x93NUMPY\x01\x00" + (NPY_HEADER_BYTES - 10).to_bytes(2, "little")


def tensors_format(path: Path) -> str | None:
    """The format name in the metadata of a safetensors file; None if there is no such file or no name."""
    try:
        with path.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if length > path.stat().st_size:
                return None
            header: dict[str, Any] = json.loads(stream.read(length))
        return str(header["__metadata__"]["format"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


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
    # a singleton of each thread counts its blocks
    lock = FileLock(path, timeout=0, is_singleton=True, on_acquired=_sign)
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
            f"{output} is being written by {_holder(lock_file(output))}; wait, stop it, or name another output"
        ) from None
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


def _is_free(lock: BaseFileLock) -> bool:
    """Take the lock if no other run holds it; true where locks are not supported."""
    try:
        lock.acquire()
    except OSError as error:
        return not isinstance(error, Timeout)
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


_LONGEST = 40
_ENDING = ".part"
REPLACED = "replaced"
"""Name of the replaced folder within a temporary folder."""
_IN_USE: dict[Path, Path] = {}


def link_target(path: str | Path) -> Path:
    """The target of a symbolic link, or the path itself, so that a link that is written remains a link."""
    path = Path(path)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextlib.contextmanager
def partial_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder next to an output, removed at the end of the block; the next run removes that of a killed run.

    The folder also contains any auxiliary files that libraries write.

    Raises:
        FileNotFoundError: the folder of the output no longer exists.
    """
    path = link_target(path)
    clear_leftovers(path)
    folder = path.parent / f"{_prefix(path.stem)}{secrets.token_hex(4)}{path.suffix}{_ENDING}"
    _IN_USE[folder] = path
    try:
        folder.mkdir(mode=0o700)
        yield folder
    except FileNotFoundError as error:
        if path.parent.is_dir():
            raise
        raise FileNotFoundError(errno.ENOENT, "the output folder no longer exists", str(path.parent)) from error
    finally:
        _remove(folder, path)
        _IN_USE.pop(folder, None)


def clear_unfinished() -> None:
    """Remove the temporary folders of this process, in case an interrupt arrived while one was created or removed."""
    for folder, path in list(_IN_USE.items()):
        if f"-{os.getpid()}-" in folder.name:  # skip folders of the process that forked this one
            _remove(folder, path)
            _IN_USE.pop(folder, None)


def _remove(folder: Path, path: Path | None) -> None:
    """Remove a temporary folder; first restore the folder that it was replacing, unless there is a new one."""
    replaced = folder / REPLACED
    if path is not None and replaced.exists() and not path.exists():
        replaced.rename(path)
    if path is not None or not replaced.exists():
        shutil.rmtree(folder, ignore_errors=True)


def clear_leftovers(path: Path) -> None:
    """Remove the leftovers that terminated processes left for an output; restore a folder that one of them was replacing. Files
    of other machines, of running processes and of other outputs are kept."""
    _clear(path.parent, rf"\.{re.escape(path.stem[:_LONGEST])}", re.escape(path.suffix), path)


def clear_all_leftovers(folder: Path) -> None:
    """As `clear_leftovers`, for all outputs in a folder of this program."""
    _clear(folder, r"\..*", r"(?:\.\w+)?", None)


def _clear(folder: Path, beginning: str, suffix: str, path: Path | None) -> None:
    name = re.compile(rf"{beginning}-{_machine()}-(\d{{1,9}})-\w{{8}}{suffix}{re.escape(_ENDING)}")
    with contextlib.suppress(OSError):
        for leftover in sorted(folder.iterdir()):
            found = name.fullmatch(leftover.name)
            if found is None or leftover.is_symlink() or _runs(int(found[1])):
                continue
            _remove(leftover, path)


def _prefix(stem: str) -> str:
    return f".{stem[:_LONGEST]}-{_machine()}-{os.getpid()}-"


@functools.cache
def _machine() -> str:
    """Eight digits that identify this machine and its process namespace, which differs between containers on one disk."""
    numbering = ""
    with contextlib.suppress(OSError):
        numbering = os.readlink("/proc/self/ns/pid")
    return f"{zlib.crc32(f'{platform.node()} {numbering}'.encode()):08x}"


def _runs(process: int) -> bool:
    if os.name == "nt":  # on Windows, os.kill would terminate the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
