"""Fields by name, and in files: safetensors with kind and settings as JSON metadata; loading runs no code from the file."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from noiseflow.installation import library_version
from noiseflow.runs.outputs import TENSORS, check_output
from noiseflow.runs.run_folder import save_tensors
from recon.fields.fields import Field
from recon.names import AUTO, FIELDS
from recon.names import field_names as field_names
from recon.series.tilt_series import Volume

# what auto compares: plain voxels converge more slowly than grids, and the network of 2022 more slowly than that of sines
_COMPARED = (FIELDS.first, "gaussians", "network")


def find_field(name: str) -> type[Field]:
    """The class of fields with a given name. Raises ValueError if the name is unknown, or ``auto``, and TypeError if the entry
    point with that name is not a field."""
    found = FIELDS.find(name)
    if not (isinstance(found, type) and issubclass(found, Field)):
        raise TypeError(f"field {name} is {found!r}; it must be a class derived from recon.Field")
    return found


def field_kinds(name: str | None) -> dict[str, type[Field]]:
    """The fields that a setting names: one, or those that ``auto`` compares; None names the default. Raises as `find_field`."""
    return {each: find_field(each) for each in (_COMPARED if name == AUTO else (name or FIELDS.first,))}


def name_of(field: Field) -> str:
    """The name of a field. Raises ValueError if its class is not registered."""
    for name in FIELDS.names():
        if name != AUTO and find_field(name) is type(field):
            return name
    raise ValueError(f"{type(field).__name__} is not a named field; register it as an entry point of {FIELDS.group}")


_FORMAT, _MASK = "noiseflow field", "occupied bits"


def save_field(field: Field, path: str | Path, *, provenance: Mapping[str, Any] | None = None) -> Path:
    """Save a field with its vacuum, voxel size and orientation.

    Args:
        field: a field whose class is registered, see `recon.fields.field_names`.
        path: target, ``.safetensors``.
        provenance: origin of the field, any JSON-serialisable mapping.

    Raises:
        ValueError: the class of the field is not registered, or the path cannot be written.
    """
    path = check_output(path, suffixes=TENSORS)
    shape = (field.depth, field.height, field.width)
    description = {"kind": name_of(field), "shape": shape, "scale": float(field.scale), "settings": field.config()}
    description |= {"voxel_size": field.voxel_size, "flipped": field.flipped, "margin": field.margin}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in field.state_dict().items()}
    if field.occupied is not None:
        tensors[_MASK] = torch.from_numpy(np.packbits(field.occupied.cpu().numpy()))
    metadata = {"format": _FORMAT, "library_version": library_version(), "field": json.dumps(description)}
    save_tensors(path, tensors, metadata | {"provenance": json.dumps(dict(provenance or {}), default=str)})
    return path


def load_field(path: str | Path) -> Field:
    """Load a field that `save_field` wrote. Raises FileNotFoundError if the file does not exist, and ValueError if it is
    another file, or damaged."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no such file: {path}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != _FORMAT:
                raise ValueError(f"{path} is not a field; `noiseflow reconstruct --save-field` writes one")
            known = json.loads(metadata["field"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        field = find_field(known["kind"])(known["shape"], scale=known["scale"], **known["settings"])
        mask = tensors.pop(_MASK, None)
        field.load_state_dict(tensors)
        if mask is not None:
            size = (field.depth, field.width, field.height)
            bits = np.unpackbits(mask.numpy(), count=math.prod(size)).astype(bool)
            field.occupied = torch.from_numpy(bits.reshape(size))
        field.voxel_size, field.margin = known["voxel_size"], known.get("margin", 0)
        field.flipped = tuple(known["flipped"])
    except (SafetensorError, KeyError, TypeError, RuntimeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no field of `reconstruct --save-field`, or is damaged ({error})") from error
    return field


def sampled_volume(field: Field, voxel_size: float | None = None) -> Volume:
    """The volume of a field with voxels of this size, Å; its own if None. Raises ValueError if the voxel size of the field is
    not known, or the new one is not positive.
    """
    if voxel_size is None:
        return Volume(field.volume().cpu().numpy(), field.voxel_size)
    if field.voxel_size is None:
        raise ValueError("--voxel-size: the field has none; reconstruct with --pixel-size, or set field.voxel_size")
    if not 0 < voxel_size < math.inf:
        raise ValueError(f"--voxel-size {voxel_size:g} must be positive and finite, in Å")
    return Volume(field.sampled(voxel_size / field.voxel_size).numpy(), voxel_size)
