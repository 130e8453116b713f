"""Output files: checked before the computation, written to a temporary file, and renamed when complete."""

import contextlib
import errno
import importlib.util
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from noiseflow.described import bytes_in_words
from noiseflow.installation import install_command
from noiseflow.runs.ownership import (
    REPLACED,
    clear_leftovers,
    link_target,
    locked,
    partial_folder,
    require_own,
    signature,
)

TENSORS = frozenset({".safetensors"})  # endings of noise models and fields


class Outputs(contextlib.ExitStack):
    """The files and folders that a command writes, each checked before it computes; files are locked until the block ends.

    Args:
        *inputs: files and folders that the command reads, or None; none of them is overwritten.
        overwrite: replace existing files even if this program did not write them.
    """

    def __init__(self, *inputs: str | Path | None, overwrite: bool) -> None:
        super().__init__()
        self._inputs, self._overwrite, self._files = inputs, overwrite, list[Path]()

    def file(self, path: Path | None, *, suffixes: frozenset[str] | None = None) -> None:
        """Check and lock a file, if there is one.

        Raises:
            ValueError, OSError: as `check_output` and `locked`, or the file is an input, or an image of a folder that is one.
        """
        if path is None:
            return
        self.no_input(path)
        check_output(path, suffixes=suffixes, overwrite=self._overwrite)
        self.enter_context(locked(path))
        self._files.append(path)

    def no_input(self, path: Path) -> None:
        """Check that a file that will be written or removed is not an input. Raises ValueError if it is one, or an image of a
        folder that is one.
        """
        from noiseflow.io.folder import files_of

        sources = [Path(str(source).partition("::")[0]) for source in self._inputs if source is not None]
        parts = (*sources, *(file for source in sources if source.is_dir() for file in files_of(source)))
        if path.exists() and any(part.exists() and path.samefile(part) for part in parts):
            raise ValueError(f"{path} is also an input and would be overwritten; name another output")

    def folder(
        self, path: Path | None, *, holds: Sequence[str] = (), num_bytes: int = 0, creates: bool = False
    ) -> None:
        """Check a folder, if there is one. It need not exist. Raises ValueError if the path, or a parent, is a file or will be
        one; FileExistsError if one of the files exists and this program did not write it; PermissionError if the folder cannot
        be created or written to; and OSError if the disk does not have enough space.

        Args:
            holds: names of the files that will be written there.
            creates: create the folder, and remove it if the run fails.
        """
        if path is None:
            return
        existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        if not existing.is_dir():
            raise ValueError(f"{existing} is a file; name a folder instead of {path}")
        for other in self._files:
            if other.resolve() in (path.resolve(), *path.resolve().parents):
                raise ValueError(f"{other} will be a file; name another folder instead of {path}")
        for name in holds:
            require_own(path / name, overwrite=self._overwrite)
        _require_writable(existing)
        free = shutil.disk_usage(existing).free
        if num_bytes > free:
            raise OSError(
                f"{path} needs {bytes_in_words(num_bytes)} and its disk has {bytes_in_words(free)} free; "
                "free some space, choose another disk or a smaller size"
            )
        if creates:
            self.enter_context(output_folder(path))

    def options(self, path: Path | None) -> None:
        """Write the options of the running command for ``--options``, if the block succeeds. Raises FileExistsError if this
        file exists and this program did not write it.

        Args:
            path: the main output: PATH.options.toml beside a file, options.toml in a folder; None for none.
        """
        call = invocation()
        if path is None or call is None:
            return
        file = options_file(path)
        require_own(file, overwrite=self._overwrite)

        def write(error: object, *_: object) -> None:
            if error is None:
                with atomic_path(file) as partial:
                    partial.write_text(call.as_toml(), encoding="utf-8")

        self.push(write)


@dataclass(frozen=True)
class Invocation:
    """How the running command was called.

    Attributes:
        words: the command's name and its arguments as typed.
        options: parameter name → its value, and whether the user set it.
    """

    words: tuple[str, ...]
    options: dict[str, tuple[Any, bool]]

    def as_toml(self) -> str:
        """The options that the user set, for ``--options``; inputs are written like other options."""
        given = {name.replace("_", "-"): value for name, (value, was_set) in self.options.items() if was_set}
        title = f"# {signature()}: options of noiseflow {self.words[0]}, for --options"
        return "\n".join([title, *(f"{name} = {_toml(value)}" for name, value in given.items())]) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value if isinstance(value, (bool, int, float)) else str(value), ensure_ascii=False)


_INVOCATION: ContextVar[Invocation | None] = ContextVar("invocation", default=None)


def invocation() -> Invocation | None:
    """The invocation of the running command; None if no command is running."""
    return _INVOCATION.get()


@contextlib.contextmanager
def invoked(call: Invocation) -> Iterator[None]:
    """Make `invocation` return this call within the block."""
    token = _INVOCATION.set(call)
    try:
        yield
    finally:
        _INVOCATION.reset(token)


def options_file(output: Path) -> Path:
    """Where a run writes its options: in its folder, or beside its file."""
    is_folder = not output.suffix or (output.is_dir() and output.suffix != ".zarr")
    return output / "options.toml" if is_folder else output.with_name(f"{output.name}.options.toml")


_CUT_SHORT = re.compile(r"\d+ requested and \d+ written")


def check_output(path: str | Path, *, suffixes: frozenset[str] | None = None, overwrite: bool = True) -> Path:
    """Check that a result can be written before a long computation starts, and return the path.

    Args:
        path: the file to write; for a link, its target is written.
        suffixes: allowed suffixes; by default those of the image formats that `write` supports.
        overwrite: replace any existing file; otherwise only files that this program wrote.

    Raises:
        ValueError: the suffix is not allowed, or the path is a folder.
        FileNotFoundError: the folder does not exist.
        FileExistsError: without `overwrite`, the file exists and this program did not write it.
        PermissionError: the folder is not writable.
        ModuleNotFoundError: the format needs the extra ``[formats]``, which is not installed.
    """
    path = require_ending(Path(path), suffixes)
    is_zarr = path.suffix.lower() == ".zarr"
    if is_zarr and importlib.util.find_spec("zarr") is None:
        raise ModuleNotFoundError(f"writing {path} needs zarr; install it with: {install_command('formats')}")
    if path.is_dir() and not is_zarr:
        raise ValueError(f"{path} is a folder; name an output file")
    target = link_target(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target.parent} does not exist; create the folder first")
    require_own(path, overwrite=overwrite)
    _require_writable(target.parent)
    clear_leftovers(target)
    return path


def require_ending(path: Path, suffixes: frozenset[str] | None = None) -> Path:
    """The path of an output; ValueError unless it has one of these endings, by default those that `write` supports."""
    from noiseflow.io.image_file import WRITE_SUFFIXES

    (*more, last) = sorted(WRITE_SUFFIXES if suffixes is None else suffixes)
    if path.suffix.lower() not in (*more, last):
        has = f"ends in '{path.suffix}'" if path.suffix else "has no ending"
        one_of = f"{', '.join(more)} or {last}" if more else last
        raise ValueError(f"the output {path} {has}; name it with the ending {one_of}")
    return path


def reserve_room(handle: int, num_bytes: int) -> None:
    """Extend an open file to a length on the disk, before a memory map would crash the program where the disk is full."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, num_bytes)
    else:
        os.ftruncate(handle, num_bytes)


def _require_writable(folder: Path) -> None:
    """Raise PermissionError if a folder is not writable, by its permissions or because creating a file fails."""
    refusal = f"{folder} is not writable; choose another output folder"
    if not os.access(folder, os.W_OK):
        raise PermissionError(refusal)
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise PermissionError(refusal) from error


def require_whole(path: Path, num_bytes: int) -> None:
    """Raise OSError if a file is too short; on a full disk some libraries lose the last buffer without an error."""
    if path.stat().st_size < num_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield the name of a temporary file that is renamed to `path`, or to the target of a link, if the block succeeds."""
    with partial_folder(path) as folder:
        partial = folder / Path(path).name
        try:
            yield partial
        except OSError as error:
            if error.errno is None and _CUT_SHORT.fullmatch(str(error)):  # NumPy's error, which hides the reason
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
            raise
        put_in_place(partial, path)


def put_in_place(partial: Path, path: str | Path) -> None:
    """Rename a complete file in a temporary folder next to an output to this output, or to the target of a link."""
    os.umask(umask := os.umask(0))
    partial.chmod(0o666 & ~umask)  # some libraries create files for their owner alone
    partial.replace(link_target(path))


@contextlib.contextmanager
def output_folder(path: str | Path, *, parents: bool = True) -> Iterator[Path]:
    """Create a folder, with its parents if needed. If the block fails and left no files, created folders are removed."""
    path = Path(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=parents, exist_ok=True)
    try:
        yield path
    except BaseException:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `path`, or the target of a link, if the block succeeds."""
    target = link_target(path)
    with partial_folder(path) as folder:
        partial = folder / "new"
        partial.mkdir()
        yield partial
        if target.exists():
            target.rename(folder / REPLACED)
        partial.rename(target)
