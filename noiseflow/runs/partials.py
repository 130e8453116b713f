"""Temporary folders for outputs. Their names identify the process, so that leftovers of killed runs can be removed."""

import contextlib
import errno
import functools
import os
import platform
import re
import secrets
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path

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
