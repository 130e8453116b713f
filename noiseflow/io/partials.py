"""Names of temporary files tell whose they are: what a killed program left is cleared away when the next writes the same."""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import re
import shutil
import zlib
from pathlib import Path

_LONGEST = 40


def partial_prefix(stem: str) -> str:
    """How the name of a temporary file of this process begins."""
    return f".{stem[:_LONGEST]}-{_machine()}-{os.getpid()}-"


def clear_leftovers(path: Path) -> None:
    """Remove what programs that no longer run left of an output; a folder that one of them was replacing is put back.

    Files of other machines, of running programs and of other names stay.
    """
    name = rf"\.{re.escape(path.stem[:_LONGEST])}-{_machine()}-(\d{{1,9}})-\w{{8}}{re.escape(path.suffix)}(\.old)?"
    with contextlib.suppress(OSError):
        for leftover in sorted(path.parent.iterdir()):
            found = re.fullmatch(name, leftover.name)
            if found is not None and not _runs(int(found[1])):
                _clear(leftover, path, replaced=found[2] is not None)


def _clear(leftover: Path, path: Path, *, replaced: bool) -> None:
    if replaced and not path.exists():
        leftover.rename(path)
    elif leftover.is_dir() and not leftover.is_symlink():
        shutil.rmtree(leftover, ignore_errors=True)
    else:
        leftover.unlink(missing_ok=True)


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
