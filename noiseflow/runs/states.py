"""Files of run states: nested values and tensors, written atomically; opening one runs no code from it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from noiseflow.runs.outputs import atomic_path
from noiseflow.runs.ownership import tensors_format
from noiseflow.runs.partials import clear_all_leftovers

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "noiseflow state 1"


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a file; if writing fails, an existing file is kept.

    Args:
        path: target.
        tensors: contiguous CPU tensors that do not share memory.
        metadata: texts by name.

    Raises:
        OSError: the file cannot be written, for example because the disk is full.
    """
    from safetensors import SafetensorError
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
    """Write nested dicts and lists of tensors, numbers and strings atomically.

    Raises:
        OSError: the file cannot be written (an earlier state is kept), or a file of another program would be replaced.
    """
    if not is_state(path) and path.exists():
        raise FileExistsError(f"{path} is not a reconstruction state written by noiseflow; move it out of this folder")
    tensors: dict[str, Tensor] = {}
    description = json.dumps(_packed(state, tensors))
    save_tensors(path, tensors, {"format": FORMAT, "state": description})


def is_state(path: Path) -> bool:
    """Whether a file was written by `write_state`; False for noise models and files of other programs."""
    return (tensors_format(path) or "").startswith(FORMAT.rstrip("0123456789"))


def read_state(path: Path) -> dict[str, Any]:
    """Read a file that `write_state` wrote.

    Raises:
        ValueError: it is another file, or damaged.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            packed = json.loads((file.metadata() or {})["state"])
            state: dict[str, Any] = _unpacked(packed, file)
    except (SafetensorError, KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(
            f"checkpoint {path} is damaged ({type(error).__name__}); remove --resume to start over"
        ) from error
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
    for file in (
        *(file for file in folder.glob("*.safetensors") if is_state(file)),
        *map(folder.joinpath, descriptions),
    ):
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
