"""The slice operator: for a single tilt axis, every y-slice is projected by the same small sparse matrix."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.projection.base import PanelledMatrix, Projector, linear

_PANEL = 32  # layers along z, or tilts


class SliceProjector(Projector):
    """Line integrals of a volume along all rays of a single-axis tilt series.

    A point (x, z) relative to the volume's centre is projected to u = x cos θ + z sin θ; y does not change. The matrix uses
    Joseph's interpolation (two voxels per ray and row; doi:10.1109/TMI.1982.4307572) and is shared by all slices. The tilt axis
    passes through the centre of the volume and, except for ``detector_offset``, through the centre of the detector.

    Args:
        tilt_angles: (tilts,) degrees.
        depth: voxels along z, the beam direction at zero tilt.
        width: voxels along x.
        detector_width: detector pixels along u; `width` if None.
        detector_offset: position of the detector centre on the u axis, pixels; a number, or one per tilt.
        dtype: data type of the matrix and of the arrays it is applied to.
        device: device of the matrix.

    Raises:
        ValueError: there are no angles, angles are not finite, sizes are below one, or the number of offsets is wrong.

    Example:
        >>> import recon, torch
        >>> A = recon.SliceProjector(tilt_angles=[-45.0, 0.0, 45.0], depth=8, width=8)
        >>> A(torch.ones(8, 4, 8)).shape  # (tilt, y, u)
        torch.Size([3, 4, 8])
        >>> A.T(torch.ones(3, 4, 8)).shape  # (z, y, x)
        torch.Size([8, 4, 8])
    """

    has_parts = True

    def __init__(
        self,
        *,
        tilt_angles: Sequence[float] | NDArray[np.floating[Any]],
        depth: int,
        width: int,
        detector_width: int | None = None,
        detector_offset: float | Sequence[float] | NDArray[np.floating[Any]] = 0.0,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        angles = np.atleast_1d(np.asarray(tilt_angles, dtype=np.float64))
        detector_width = width if detector_width is None else detector_width
        if angles.ndim != 1 or angles.size == 0 or not np.isfinite(angles).all():
            raise ValueError("tilt_angles must be a list of finite angles in degrees, one per tilt")
        if min(depth, width, detector_width) < 1:
            raise ValueError(f"depth {depth}, width {width} and detector_width {detector_width} must be at least one")
        offsets = np.asarray(detector_offset, dtype=np.float64)
        if offsets.size not in (1, angles.size):
            raise ValueError(f"detector_offset: {offsets.size} values, {angles.size} tilts; give one, or one per tilt")
        self.tilt_angles = angles
        self.depth, self.width, self.detector_width = depth, width, detector_width
        self.detector_offset = np.broadcast_to(offsets.ravel(), angles.shape)
        self._halves: dict[tuple[int, ...], SliceProjector] = {}
        if torch.device(device).type == "cpu":
            self.transposed = self._by_panels(dtype)
        else:
            entries = joseph(angles, self.detector_offset, depth, width, detector_width)
            self._set_entries(*entries, device=device, dtype=dtype)

    def __repr__(self) -> str:
        low, high = self.tilt_angles.min(), self.tilt_angles.max()
        kind = str(self.dtype).removeprefix("torch.")
        return (
            f"SliceProjector({self.num_tilts} tilts {low:g}° to {high:g}°, {self.depth} x {self.width} voxels (z, x) to "
            f"{self.detector_width} pixels, {kind} on {self.device})"
        )

    def _by_panels(self, dtype: torch.dtype) -> PanelledMatrix:
        """The transposed matrix, built from a few tilts at a time; all at once would need several times its memory."""
        kind, panels = torch.empty((), dtype=dtype).numpy().dtype, list[Tensor]()
        for start in range(0, self.num_tilts, _PANEL):
            angles, offsets = (each[start : start + _PANEL] for each in (self.tilt_angles, self.detector_offset))
            rays, voxels, weights = joseph(angles, offsets, self.depth, self.width, self.detector_width)
            shape = (self.depth * self.width, len(angles) * self.detector_width)
            panels += PanelledMatrix.of(voxels, rays, weights.astype(kind), shape, panel=shape[1]).panels
        return PanelledMatrix(panels)

    @cached_property
    def matrix(self) -> PanelledMatrix:
        """The matrix from the voxels of a slice to its rays; created on first use (not needed if vacuum is skipped)."""
        return self.transposed.turned(_PANEL * self.width)

    def _set_entries(
        self, rays: NDArray[np.int64], voxels: NDArray[np.int64], weights: NDArray[np.float64], **kind: Any
    ) -> None:
        shape = (self.num_tilts * self.detector_width, self.depth * self.width)
        whole = torch.device(kind["device"]).type != "cpu"
        panels = shape[::-1] if whole else (_PANEL * self.width, _PANEL * self.detector_width)
        self.matrix = PanelledMatrix.of(rays, voxels, weights, shape, panel=panels[0]).to(**kind)
        self.transposed = PanelledMatrix.of(voxels, rays, weights, shape[::-1], panel=panels[1]).to(**kind)

    @property
    def device(self) -> torch.device:
        return self.transposed.panels[0].device

    @property
    def dtype(self) -> torch.dtype:
        return self.transposed.panels[0].dtype

    def project(self, columns: Tensor) -> Tensor:
        return linear(columns, self._times)

    def backproject(self, rays: Tensor) -> Tensor:
        return linear(rays, self._times, transposed=True)

    def _times(self, dense: Tensor, transposed: bool) -> Tensor:
        return (self.transposed if transposed else self.matrix) @ dense

    def layers(self, layer_of: Callable[[NDArray[np.float64]], NDArray[np.int64]]) -> list[SliceProjector]:
        """Operators of layers perpendicular to the beam, whose sum is this operator.

        Args:
            layer_of: function from distances to the tilt axis along the beam, voxels, to indices of layers from 0.
        """
        rays, voxels, weights = self.matrix.entries()
        theta = np.deg2rad(self.tilt_angles)[rays // self.detector_width]
        z, x = voxels // self.width - (self.depth - 1) / 2, voxels % self.width - (self.width - 1) / 2
        layer = layer_of(z * np.cos(theta) - x * np.sin(theta))
        parts = []
        for number in range(int(layer.max(initial=0)) + 1):
            here, part = layer == number, copy.copy(self)
            part._halves = {}
            part._set_entries(rays[here], voxels[here], weights[here], device=self.device, dtype=self.dtype)
            parts.append(part)
        return parts

    def part(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        transposed, matrix = self.transposed.some_rows(columns)
        return matrix, transposed

    def half(self, depth: int, width: int, num_columns: int, first_columns: NDArray[np.int64]) -> SliceProjector:
        key = (depth, width, num_columns, *first_columns.tolist())
        if key not in self._halves:  # cached, because blocks of one volume need the same one
            middle = first_columns + num_columns - 1 - (self.detector_width - 1) / 2
            self._halves[key] = SliceProjector(
                tilt_angles=self.tilt_angles,
                depth=depth,
                width=width,
                detector_width=num_columns,
                detector_offset=(middle + self.detector_offset) / 2,
                dtype=self.dtype,
                device=self.device,
            )
        return self._halves[key]


def joseph(
    angles: NDArray[np.float64], offsets: NDArray[np.float64], depth: int, width: int, detector_width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Row (ray), column (voxel) and weight of every non-zero element of the matrix."""
    rays, voxels, weights = [], [], []
    x, z = np.arange(width) - (width - 1) / 2, np.arange(depth) - (depth - 1) / 2
    for tilt, (angle, offset) in enumerate(zip(np.deg2rad(angles), offsets, strict=True)):
        u = np.arange(detector_width) - (detector_width - 1) / 2 + offset
        cosine, sine = np.cos(angle), np.sin(angle)
        along_z = abs(cosine) >= abs(sine)
        if along_z:  # one step per row along z: position along x where the ray crosses it
            crossing = (u[:, None] - z * sine) / cosine + (width - 1) / 2
            step, size = 1 / abs(cosine), width
        else:
            crossing = (u[:, None] - x * cosine) / sine + (depth - 1) / 2
            step, size = 1 / abs(sine), depth
        low = np.floor(crossing)
        for neighbour, share in ((low, 1 - (crossing - low)), (low + 1, crossing - low)):
            inside = (neighbour >= 0) & (neighbour < size) & (share > 0)
            ray, row = np.nonzero(inside)
            across = neighbour[inside].astype(np.int64)
            rays.append(tilt * detector_width + ray)
            voxels.append(row * width + across if along_z else across * width + row)
            weights.append(share[inside] * step)
    return np.concatenate(rays), np.concatenate(voxels), np.concatenate(weights)
