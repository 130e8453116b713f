"""Line integrals about two tilt axes: the slice operator, stacked on a second one on the turned voxel grid."""

from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.projection.base import PanelledMatrix, Projector, linear
from recon.projection.defocused_projector import with_defocus
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import TiltSeries, VolumeGrid

_SQUARE = 45.0  # degrees: an axis farther from 90° than this would be nearer to the first axis
_KEYS = -0.5  # of cubic convolution (Keys 1981, doi:10.1109/TASSP.1981.1163711); third-order accurate


class DualAxisProjector(Projector):
    """Line integrals of a volume about an axis along y and a second axis near x.

    All images show the specimen in the same orientation at zero tilt. About the first axis, a point (x, y, z) relative to the
    centre lands at u = x cos θ + z sin θ, as in `SliceProjector`. About the second axis, whose direction is ψ, it lands at the
    same place along the axis, and at y' cos θ + z sin θ across it, where (x', y') are its coordinates turned by ψ − 90°. For
    ψ = 90° only the order of voxels changes; otherwise layers are turned with cubic convolution.

    Args:
        tilt_angles: (tilt,) degrees.
        axes: (tilt,) directions of the tilt axes, degrees from y towards −x: 0 or, about the second axis, one number within 45°
            of 90.
        depth, height, width: voxels along z, y and x; images have height x width pixels.
        dtype: data type of the matrices and of the arrays they are applied to.
        device: device of the matrices.

    Raises:
        ValueError: there are not exactly two axes, or the second one is too close to the first.

    Example:
        >>> import recon, torch
        >>> A = recon.DualAxisProjector(tilt_angles=[-45.0, 45.0, -45.0], axes=[0.0, 0.0, 90.0], depth=4, height=6, width=8)
        >>> A(torch.ones(4, 6, 8)).shape  # (tilt, y, x)
        torch.Size([3, 6, 8])
    """

    def __init__(
        self,
        *,
        tilt_angles: NDArray[np.floating[Any]],
        axes: NDArray[np.floating[Any]],
        depth: int,
        height: int,
        width: int,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        angles, directions = (np.asarray(values, dtype=np.float64) for values in (tilt_angles, axes))
        second = directions != 0
        turns = np.unique(directions[second]) - 90
        if angles.shape != directions.shape or second.all() or len(turns) != 1 or abs(turns[0]) > _SQUARE:
            raise ValueError(f"axes {np.unique(directions)} must be 0 and one angle within {_SQUARE:g}° of 90")
        self.tilt_angles, self.axes = angles, directions
        self.depth, self.height, self.width, self.detector_width = depth, height, width, width
        self.fixed_height = height
        kind: dict[str, Any] = {"dtype": dtype, "device": device}
        self._first = SliceProjector(tilt_angles=angles[~second], depth=depth, width=width, **kind)
        self._second = SliceProjector(tilt_angles=angles[second], depth=depth, width=height, **kind)
        self._turn = None if turns[0] == 0 else _layer_turn(float(turns[0]), width, height).to(**kind)
        self._back = None if self._turn is None else self._turn.turned(width * height)
        order = np.concatenate([np.flatnonzero(~second), np.flatnonzero(second)])
        self._order, self._place = (torch.from_numpy(each).to(device) for each in (order, np.argsort(order)))

    def __repr__(self) -> str:
        return f"DualAxisProjector({self._first!r}, {self._second.num_tilts} tilts about {self.axes.max():.4g}°)"

    @property
    def device(self) -> torch.device:
        return self._first.device

    @property
    def dtype(self) -> torch.dtype:
        return self._first.dtype

    def project(self, columns: Tensor) -> Tensor:
        return linear(columns, self._times)

    def backproject(self, rays: Tensor) -> Tensor:
        return linear(rays, self._times, transposed=True)

    def _times(self, dense: Tensor, transposed: bool) -> Tensor:
        given = dense.view(-1, self.width, self.height)
        if not transposed:
            turned = self._turned(self._turn, given).transpose(1, 2).reshape(self.depth * self.height, self.width)
            second = self._second.project(turned).view(-1, self.height, self.width).transpose(1, 2)
            images = torch.cat([self._first.project(dense).view(-1, *given.shape[1:]), second])
            return images[self._place].reshape(-1, self.height)
        images, count = given[self._order], self._first.num_tilts
        first, second = images[:count], images[count:]
        columns = self._first.backproject(first.reshape(-1, self.height))
        across = second.transpose(1, 2).reshape(-1, self.width)
        layers = self._second.backproject(across).view(self.depth, self.height, self.width).transpose(1, 2)
        return columns + self._turned(self._back, layers).reshape(columns.shape)

    def _turned(self, turn: PanelledMatrix | None, layers: Tensor) -> Tensor:
        if turn is None:
            return layers
        return (turn @ layers.reshape(self.depth, -1).T.contiguous()).T.reshape(layers.shape)


def projector_of(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    device: torch.device | str = "cpu",
    defocus: float = 0.0,
    kernel: str = "depth",
) -> Projector:
    """Line integrals through a grid along the rays of a series, about one axis or two. Raises ValueError if the series has two
    axes, and the grid does not match its images or a defocus is given.
    """
    _, height, width = tilt_series.images.shape
    if tilt_series.axes is None:
        in_focus = SliceProjector(
            tilt_angles=tilt_series.tilt_angles, depth=grid.depth, width=grid.width, detector_width=width, device=device
        )
        return with_defocus(in_focus, defocus, kernel)
    if defocus:
        raise ValueError("--defocus is for one tilt axis; remove it, or reconstruct each axis alone")
    if (height, width) != grid.shape[1:]:
        raise ValueError(f"a dual-axis volume of {height} x {width} images must be {height} x {width} voxels (y, x)")
    sizes = {"depth": grid.depth, "height": height, "width": width}
    return DualAxisProjector(tilt_angles=tilt_series.tilt_angles, axes=tilt_series.axes, device=device, **sizes)


def _layer_turn(degrees: float, width: int, height: int) -> PanelledMatrix:
    """The matrix that turns a layer (x, y), flat: its value at (x', y') is that at (x' cos γ − y' sin γ, x' sin γ + y' cos γ)."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2, indexing="ij")
    turned = x * cosine - y * sine + (width - 1) / 2, x * sine + y * cosine + (height - 1) / 2
    taps = [_taps(place.ravel()) for place in turned]
    entries = list[Any]()
    for (near_x, share_x), (near_y, share_y) in product(*taps):
        inside = (near_x >= 0) & (near_x < width) & (near_y >= 0) & (near_y < height)
        places = np.flatnonzero(inside), (near_x * height + near_y)[inside], (share_x * share_y)[inside]
        entries.append(places)
    size = width * height
    row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return PanelledMatrix.of(row, column, value, (size, size), panel=size)


def _taps(place: NDArray[np.float64]) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Four neighbours of each position and their weights, by cubic convolution."""
    low = np.floor(place).astype(np.int64)
    found = []
    for step in (-1, 0, 1, 2):
        apart = np.abs(place - low - step)
        near = ((_KEYS + 2) * apart - (_KEYS + 3)) * apart**2 + 1
        far = ((apart - 5) * apart + 8) * apart * _KEYS - 4 * _KEYS
        found.append((low + step, np.where(apart <= 1, near, far)))
    return found
