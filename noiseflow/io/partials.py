"""Names of temporary folders tell whose they are: what a killed program left is cleared away when the next writes the same."""

from __future__ import annotations

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
"""Name, within a temporary folder, of the folder that is being replaced."""
_IN_USE: dict[Path, Path] = {}


def link_target(path: str | Path) -> Path:
    """What a symbolic link points to, or the path itself: a link that is written stays a link."""
    path = Path(path)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextlib.contextmanager
def partial_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside an output, gone when the block ends; a killed run's is cleared by the next one.

    Whatever libraries leave beside the files they write lies in it, too.

    Raises:
        FileNotFoundError: the output's folder is gone.
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
        raise _gone(path.parent) from error
    finally:
        _remove(folder, path)
        _IN_USE.pop(folder, None)


def clear_unfinished() -> None:
    """Remove the temporary folders of this program: an interrupt may come while one is made or removed, at any line."""
    for folder, path in list(_IN_USE.items()):
        if f"-{os.getpid()}-" in folder.name:  # not a folder of the process that forked this one
            _remove(folder, path)
            _IN_USE.pop(folder, None)


def _remove(folder: Path, path: Path | None) -> None:
    """Remove a temporary folder; what it was replacing is put back first, where nothing has taken its place."""
    replaced = folder / REPLACED
    if path is not None and replaced.exists() and not path.exists():
        replaced.rename(path)
    if path is not None or not replaced.exists():
        shutil.rmtree(folder, ignore_errors=True)


def _gone(folder: Path) -> FileNotFoundError:
    return FileNotFoundError(errno.ENOENT, "the output folder does not exist any more", str(folder))


def clear_leftovers(path: Path) -> None:
    """Remove what programs that no longer run left of an output; a folder that one of them was replacing is put back.

    Files of other machines, of running programs and of other names stay.
    """
    _clear(path.parent, rf"\.{re.escape(path.stem[:_LONGEST])}", re.escape(path.suffix), path)


def clear_all_leftovers(folder: Path) -> None:
    """Remove what programs that no longer run left of any output in a folder of ours; all else stays, as above."""
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
    """Eight digits for this machine and its numbering of processes: containers that share a disk do not share that."""
    numbering = ""
    with contextlib.suppress(OSError):
        numbering = os.readlink("/proc/self/ns/pid")
    return f"{zlib.crc32(f'{platform.node()} {numbering}'.encode()):08x}"


def _runs(process: int) -> bool:
    if os.name == "nt":  # where asking would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
