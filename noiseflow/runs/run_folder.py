"""The folder of a run that can be interrupted: what determines the run, and the files of states that it resumes from."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from noiseflow.installation import library_version
from noiseflow.runs.outputs import atomic_path, output_folder
from noiseflow.runs.ownership import clear_all_leftovers, is_own, tensors_format

if TYPE_CHECKING:
    from torch import Tensor

_FORMAT = "noiseflow checkpoint 2"
_RUN_START = b'{\n "format": "noiseflow checkpoint '
_RUN, _BLOCKS = "run.json", "blocks-"


class RunFolder:
    """Settings of a run, choices that it made, and states by name, each written atomically.

    Args:
        folder: created with the first state.
        settings: JSON-serialisable settings that determine the result, by name. A folder with other settings is rejected.
        resume: continue from the contents of the folder; otherwise the first state replaces them.

    Raises:
        ValueError: the folder belongs to a run with other settings, or is damaged.
    """

    def __init__(self, folder: str | Path, settings: dict[str, Any], *, resume: bool = False) -> None:
        self.folder = Path(folder)
        self.settings, self._choices = json.loads(json.dumps(settings)), dict[str, Any]()
        self._fresh = not (resume and self.exists)
        if not self._fresh:
            self._check_settings()

    @property
    def exists(self) -> bool:
        """Whether the folder holds a journal."""
        return (self.folder / _RUN).is_file()

    @property
    def resumed(self) -> bool:
        """Whether this run continues an earlier one."""
        return not self._fresh

    def choose(self, name: str, find: Callable[[], Any]) -> Any:
        """Return the JSON-serialisable result of `find`, or the one that the run stored before it was interrupted, so that a
        resumed run does not depend on the state of the machine. Must be called before anything is written."""
        if name not in self._choices:
            self._choices[name] = find()
        return self._choices[name]

    def keep(self, prefix: str = "") -> Path:
        """The folder for finished blocks of a volume, named after the prefix of its fits; removed with the journal."""
        if self._fresh:
            self._start()
        return self.folder / f"{_BLOCKS}{hashlib.blake2b(prefix.encode(), digest_size=4).hexdigest()}"

    def forget(self, prefix: str) -> None:
        """Remove the states of fits with this prefix, whose block is stored and smaller than they are."""
        for file in filter(is_state, self.folder.glob(f"{_slug(prefix)}*.safetensors")):
            file.unlink()

    def discard(self) -> None:
        """Remove the journal of a complete or abandoned run."""
        for blocks in self.folder.glob(f"{_BLOCKS}{'[0-9a-f]' * 8}"):
            clear_all_leftovers(blocks)
            for file in blocks.glob("*-[0-9]*-[0-9]*.npy"):
                if is_own(file):
                    file.unlink()
            if not any(blocks.iterdir()):
                blocks.rmdir()
        discard_states(self.folder, _RUN)

    def _finished(self, name: str) -> Path:
        digest = hashlib.blake2b(name.encode(), digest_size=4).hexdigest()
        return self.folder / f"{_slug(name)}-{digest}.safetensors"

    def _write(self, path: Path, state: dict[str, Any]) -> None:
        if self._fresh:
            self._start()
        write_state(path, state)

    def _start(self) -> None:
        run = self.folder / _RUN
        head = run.read_bytes()[: len(_RUN_START)] if run.is_file() else b""
        if head and head != _RUN_START:
            raise FileExistsError(f"{run} was not written by noiseflow; move it, or name another output")
        self.discard()
        description = {"format": _FORMAT, "library_version": library_version(), "settings": self.settings}
        description["choices"] = self._choices
        with output_folder(self.folder, parents=False), atomic_path(run) as partial:
            partial.write_text(json.dumps(description, indent=1), encoding="utf-8")
        self._fresh = False

    def _check_settings(self) -> None:
        advice = f"give the same input and options, or remove --resume to start over ({self.folder})"
        try:
            kept = json.loads((self.folder / _RUN).read_text(encoding="utf-8"))
            format_, settings = kept["format"], dict(kept["settings"])
            self._choices = dict(kept.get("choices", {}))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"the checkpoint's {_RUN} is damaged; {advice}") from error
        if format_ != _FORMAT or kept.get("library_version") != library_version():
            raise ValueError(f"the checkpoint was written by another version of noiseflow; {advice}")
        names = [name for name in {**settings, **self.settings} if settings.get(name) != self.settings.get(name)]
        if names:
            changes = ", ".join(f"{name} was {settings.get(name)}, now {self.settings.get(name)}" for name in names)
            raise ValueError(f"the checkpoint is of another run: {changes}; {advice}")


def _slug(name: str) -> str:
    return re.sub("[^a-z0-9.]+", "-", name.lower())[:60]


FORMAT = "noiseflow state 1"


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a file; if writing fails, an existing file is kept. Raises OSError if the file cannot be written, for example
    because the disk is full.

    Args:
        tensors: contiguous CPU tensors that do not share memory.
    """
    from safetensors.torch import save_file

    with atomic_path(path) as partial:
        try:
            save_file(tensors, partial, metadata=dict(metadata))
        except SafetensorError as error:  # system errors are only part of its message
            found = re.search(r"os error (\d+)", str(error))
            if found is None:
                raise
            raise OSError(int(found[1]), os.strerror(int(found[1])), str(path)) from error


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Write nested dicts and lists of tensors, numbers and strings atomically. Raises OSError if the file cannot be written (an
    earlier state is kept), or a file of another program would be replaced.
    """
    if not is_state(path) and path.exists():
        raise FileExistsError(f"{path} is not a reconstruction state written by noiseflow; move it out of this folder")
    tensors: dict[str, Tensor] = {}
    save_tensors(path, tensors, {"format": FORMAT, "state": json.dumps(_packed(state, tensors))})


def is_state(path: Path) -> bool:
    """Whether a file was written by `write_state`; False for noise models and files of other programs."""
    return (tensors_format(path) or "").startswith(FORMAT.rstrip("0123456789"))


def read_state(path: Path) -> dict[str, Any]:
    """Read a file that `write_state` wrote. Raises ValueError if it is another file, or damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            state: dict[str, Any] = _unpacked(json.loads((file.metadata() or {})["state"]), file)
    except (SafetensorError, KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{path} is damaged ({type(error).__name__}); remove --resume to start over") from error
    return state


def discard_states(folder: Path, *descriptions: str) -> None:
    """Remove the states in a folder, and the folder if it is then empty; other files are kept.

    Args:
        folder: folder of the states; it need not exist.
        descriptions: names of further files of the run to remove.
    """
    if not folder.is_dir():
        return
    clear_all_leftovers(folder)
    for file in (*filter(is_state, folder.glob("*.safetensors")), *map(folder.joinpath, descriptions)):
        file.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _packed(value: Any, tensors: dict[str, Tensor]) -> Any:
    from torch import Tensor

    if isinstance(value, Tensor):
        name = str(len(tensors))
        kept = value.detach().cpu().contiguous()
        whole = kept.untyped_storage().nbytes() == kept.numel() * kept.element_size()
        shared = any(kept.data_ptr() == other.data_ptr() for other in tensors.values())
        tensors[name] = kept if whole and not shared else kept.clone()
        return {"tensor": name}
    if isinstance(value, dict):
        return {"dict": [[key, _packed(item, tensors)] for key, item in value.items()]}
    if isinstance(value, (list, tuple)):
        return {"list": [_packed(item, tensors) for item in value]}
    if isinstance(value, (str, int, float, bool, type(None))):
        return value
    raise TypeError(f"a checkpoint cannot hold {type(value).__name__}")


def _unpacked(value: Any, file: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if "tensor" in value:
        return file.get_tensor(value["tensor"])
    if "dict" in value:
        return {key: _unpacked(item, file) for key, item in value["dict"]}
    return [_unpacked(item, file) for item in value["list"]]
