"""`Field`, the base class of volume parameterisations: what a fit sees of one, what its result can do, and its file."""

from __future__ import annotations

import json
import math
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from noiseflow.arrays import Given, alike, as_tensor
from noiseflow.distributions.numerics.elementwise import LONG
from noiseflow.installation import library_version
from noiseflow.models.base import Described
from noiseflow.runs.outputs import TENSORS, check_output
from noiseflow.runs.run_folder import save_tensors
from recon.names import AUTO, FIELDS
from recon.names import field_names as field_names
from recon.projection.base import from_columns
from recon.projection.tiles import Tiles
from recon.series.tilt_series import Volume

COARSE = 24  # voxels along each axis of a rough volume: finer detail is noise
EMPTY = 0.003
"""Attenuation of an empty field, in units of its scale; low, because a haze would be fitted as a brighter beam."""


class Field(Described, ABC):
    """Base class of fields: trainable volumes of non-negative attenuation.

    A subclass defines `units` and `start_from`. A field that is a function of continuous coordinates also defines `units_at`;
    by default, values between voxels are interpolated linearly. Fits use `units`, `of_voxels` and `on`. `at`, `sampled` and
    `volume` give the result of a fit: vacuum outside `occupied`, in the orientation of the given series.

    Args:
        shape: (depth, height, width) of the voxel grid, voxels along (z, y, x).
        scale: attenuation per voxel of one unit; a guess within a factor of ten suffices.

    Example:
        >>> import recon, torch
        >>> field = recon.VoxelField((4, 6, 8))
        >>> isinstance(field, recon.Field), field.volume().shape
        (True, torch.Size([4, 6, 8]))
    """

    measured_in = "attenuation per voxel"
    scale: Tensor
    relative_rate = relative_weight = 1.0
    """Learning rate of the field relative to that of a voxel field, and weight of the regulariser relative to the one chosen
    with grids; less for fields that are smooth themselves."""
    own_rates: ClassVar[Mapping[str, float]] = {}
    """Learning rates of single parameters, by name, relative to that of the field."""
    memory: float | None = 0.8
    """Share of the mean slope and square that Adam keeps at a step; None for 0.9 and 0.99. Beside first slopes, those of what the
    missing wedge hides are small: with None and half as many steps again, vesicles in ice lose 1.9 dB, 37 series 0.15 dB."""
    num_steps: int | None = None
    """Steps of a fit of the whole volume; None for those of the schedule."""
    step_cost = 1.0
    """Time of a step relative to that of grids."""
    halved_from: tuple[int, ...] = (128, 257)
    """Widths in voxels from which the resolution of the first steps is halved once and twice. Below, grids lose 0.2 dB (shells
    of 96³, a slab of 256³)."""
    more_memory = 0
    """Bytes that a fit of this field needs besides those of a fit of voxels."""
    voxel_size: float | None = None
    """Edge length of a voxel, Å; None if unknown."""
    occupied: Tensor | None = None
    """(depth, width, height) False where a fit skipped voxels as vacuum; None if it skipped none."""
    margin: int
    """Voxels on either side along x that a fit added to the volume, because the object extends there."""
    flipped: tuple[int, ...] = ()
    """Axes of (z, y, x) along which the fit saw the series reversed."""

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0) -> None:
        super().__init__()
        if len(shape) != 3 or min(shape) < 1:
            raise ValueError(f"shape {tuple(shape)}: give three sizes (depth, height, width) of at least one voxel")
        if not 0 < scale < math.inf:
            raise ValueError(f"scale {scale} must be positive and finite")
        self.depth, self.height, self.width = shape
        self.margin = 0
        self.register_buffer("scale", torch.tensor(float(scale)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(depth, height, width) of the volume, without the margin."""
        return self.depth, self.height, self.width - 2 * self.margin

    @abstractmethod
    def units(self) -> Tensor:
        """Non-negative attenuation in units of the scale, (depth, width, height)."""

    def of_voxels(self, places: Tensor) -> Tensor:
        """Attenuation, in units of the scale, of voxels with (N,) flat indices in the grid (z, x, y)."""
        return self.units().reshape(-1).index_select(0, places)

    def on(self, tiles: Tiles) -> Tensor:
        """Attenuation on the list of `tiles`, (N,), in units of the scale; zero at unoccupied voxels."""
        values = self.of_voxels(tiles.voxels)
        return values.new_zeros(tiles.filled.numel()).index_copy(0, tiles.occupied, values)

    def units_at(self, points: Tensor) -> Tensor:
        """Attenuation in units of the scale, (N,), at (N, 3) points (z, y, x) in voxels, with voxel centres at integers."""
        sizes = points.new_tensor([self.depth, self.height, self.width])
        relative = (2 * points + 1) / sizes - 1  # edges of the box at ±1
        lattice = self.units().transpose(1, 2)[None, None]
        options: dict[str, Any] = {"mode": "bilinear", "padding_mode": "border", "align_corners": False}
        found = functional.grid_sample(lattice, relative.flip(-1)[None, None, None].to(lattice), **options)
        return found.reshape(-1)

    def at(self, points: Given, *, unit: str = "voxels") -> Given:
        """Attenuation per voxel at any points of the volume.

        Args:
            points: (N, 3) coordinates (z, y, x), floating-point. The first voxel has its centre at 0.
            unit: ``voxels``, or ``Å`` if `voxel_size` is known.

        Returns:
            (N,) values, differentiable with respect to the parameters of the field.

        Raises:
            ValueError: wrong shape, type or unit, or a point outside the volume.
        """
        places = as_tensor(points)
        if places.ndim != 2 or places.shape[1] != 3 or not places.is_floating_point():
            what = f"points {tuple(places.shape)} of {places.dtype}"
            raise ValueError(f"{what}: give (N, 3) floating-point coordinates (z, y, x)")
        unit = unicodedata.normalize("NFC", unit)  # the ångström sign, U+212B, is Å
        if unit not in ("voxels", "Å"):
            raise ValueError(f"unit {unit!r}: choose 'voxels' or 'Å'")
        if unit == "Å":
            if self.voxel_size is None:
                raise ValueError("this field has no voxel size; give points in voxels, or set field.voxel_size")
            places = places / self.voxel_size
        places = places.to(self.scale.device)
        last = places.new_tensor(self.shape) - 1
        outside = ~((places >= -0.5) & (places <= last + 0.5)).all(1)
        if bool(outside.any()):
            raise ValueError(
                f"{int(outside.sum())} of {len(places)} points lie outside the volume, which extends over -0.5 to "
                f"{', '.join(f'{size - 0.5:g}' for size in self.shape)} voxels along z, y and x"
            )
        reverse = places.new_tensor([float(axis in self.flipped) for axis in range(3)])
        places = reverse * (last - places) + (1 - reverse) * places
        places = places + places.new_tensor([0, 0, self.margin])
        values = self.units_at(places.to(self.scale.dtype)) * self.scale
        if self.occupied is not None:
            last[2] += 2 * self.margin
            z, y, x = places.round().long().clamp(min=torch.zeros_like(last.long()), max=last.long()).unbind(1)
            values = values * self.occupied[z, x, y]
        return alike(values, points)

    @torch.no_grad()
    def sampled(self, ratio: float) -> Tensor:
        """The volume (z, y, x) on another grid with the same centre, attenuation per voxel of that grid.

        Args:
            ratio: size of its voxels relative to those of this field. Larger voxels are means over several points.
        """
        if not 0 < ratio < math.inf:
            raise ValueError(f"ratio {ratio} of voxel sizes must be positive and finite")
        sizes = [max(1, math.floor(size / ratio + 1e-6)) for size in self.shape]
        per_voxel = math.ceil(ratio - 1e-6)
        axes = []
        for size, own in zip(sizes, self.shape, strict=True):
            fine = (torch.arange(size * per_voxel, dtype=torch.float64) + 0.5) / per_voxel - size / 2
            axes.append((fine * ratio + (own - 1) / 2).clamp(-0.5, own - 0.5))
        found = torch.empty(sizes)
        layers = max(1, LONG // (len(axes[1]) * len(axes[2]) * per_voxel))
        for first in range(0, sizes[0], layers):
            z = axes[0][first * per_voxel : (first + layers) * per_voxel]
            points = torch.stack(torch.meshgrid(z, *axes[1:], indexing="ij"), -1)
            values = self.at(points.view(-1, 3)).cpu().view(1, 1, *points.shape[:3])
            found[first : first + layers] = functional.avg_pool3d(values.float(), per_voxel)[0, 0]
        return found * ratio

    @abstractmethod
    def start_from(self, volume: Tensor) -> None:
        """Initialise with a rough volume (z, y, x) of the same extent and any resolution, with vacuum raised slightly."""

    @torch.no_grad()
    def check_axes(self, volume: Tensor, *, nearer: float = 0.25) -> None:
        """Check the order of axes by a coarse comparison with the volume (z, y, x) that initialised the field. Raises
        ValueError if the field has y and x swapped, which shapes cannot reveal if slices are square, and is then `nearer` by this
        ratio of squared distances: detail lost by a smooth field contributes equally to both."""
        held = self.volume()
        if self.height != self.width:
            return
        depth, height, width = (min(COARSE, *pair) for pair in zip(held.shape, volume.shape, strict=True))
        size = (depth, height, width)
        held, given = (functional.adaptive_avg_pool3d(each[None, None].float(), size) for each in (held, volume))
        straight, swapped = (float((held - each).square().sum()) for each in (given, given.transpose(-1, -2)))
        if swapped < nearer * straight:
            raise ValueError(
                f"{type(self).__name__} was initialised with a volume and has y and x swapped; units() has the axes "
                "(z, x, y), volumes have (z, y, x): transpose in start_from() or in units()"
            )

    def coarser(self) -> Field | None:
        """This field on a voxel grid with half the resolution, with shared parameters. None if there is no such grid."""
        return None

    def _raw_of(self, volume: Tensor, shape: Sequence[int]) -> Tensor:
        """Unconstrained values of a volume (z, y, x) resampled to `shape`, (depth, width, height)."""
        lattice = volume.transpose(1, 2)[None, None] / self.scale
        pooled = functional.adaptive_avg_pool3d(lattice, (shape[0], shape[1], shape[2]))[0, 0]
        return torch.log(torch.expm1(pooled.clamp(EMPTY, 20)))

    def forward(self) -> Tensor:
        """Attenuation per voxel, (depth * width, height)."""
        values = self.units() * self.scale
        expected = (self.depth, self.width, self.height)
        if values.shape != expected:
            raise ValueError(f"{type(self).__name__}.units() is {tuple(values.shape)}; give (z, x, y) = {expected}")
        return values.reshape(self.depth * self.width, self.height)

    def extra_repr(self) -> str:
        """Voxel grid and scale."""
        return f"{self.depth} x {self.height} x {self.width} voxels (z, y, x), scale={float(self.scale):.4g}"

    def volume(self) -> Tensor:
        """The attenuation as (z, y, x), detached."""
        with torch.no_grad():
            values = self() if self.occupied is None else self() * self.occupied.reshape(-1, self.height)
            wide = from_columns(values, self.depth)
            return wide[:, :, self.margin : self.width - self.margin].flip(self.flipped).contiguous()

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this field, besides shape and scale; JSON-serialisable."""
        return {}


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
