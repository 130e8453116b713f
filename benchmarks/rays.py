"""Rays through a volume in any direction: x-tilt, dual axis. Slower than the slice operator; the results agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

Angles = float | Sequence[float] | NDArray[np.floating]
_AT_ONCE = 2**21
_ORDER = (0, 2, 1)  # precedence of equally steep axes: z, then x, then y


def view_matrices(tilt_angles: Angles, *, x_tilt: Angles = 0.0, in_plane: Angles = 0.0) -> NDArray[np.float64]:
    """Rotation matrices from the specimen (z, y, x) to the microscope (beam, v, u), for every tilt.

    The specimen is rotated in its plane (about z), then tilted about x, then about the tilt axis y. A dual-axis series consists
    of two series whose `in_plane` differs by 90°. With both at 0, u = x·cos θ + z·sin θ and v = y.

    Args:
        tilt_angles: (tilts,) degrees.
        x_tilt: degrees; a number, or one per tilt.
        in_plane: degrees; a number, or one per tilt.

    Returns:
        (tilts, 3, 3).
    """
    theta, chi, phi = np.broadcast_arrays(*(np.deg2rad(np.atleast_1d(a)) for a in (tilt_angles, x_tilt, in_plane)))
    tilt = _rotation(theta, (0, 2), -1)
    return np.asarray(tilt @ _rotation(chi, (0, 1), 1) @ _rotation(phi, (1, 2), 1))


def view_rays(views: NDArray[np.float64], *, height: int, width: int, offset: float = 0.0) -> tuple[Tensor, Tensor]:
    """One ray through every pixel of every view.

    Args:
        views: (tilts, 3, 3) from `view_matrices`.
        height, width: size of the detector, pixels.
        offset: position of the detector centre on the u axis, pixels.

    Returns:
        Origins and directions, (tilt, v, u, 3) each, voxels along (z, y, x) from the centre of the volume. Directions have a
        length of one voxel.
    """
    turned = torch.from_numpy(np.asarray(views, dtype=np.float64))
    v = torch.arange(height, dtype=torch.float64) - (height - 1) / 2
    u = torch.arange(width, dtype=torch.float64) - (width - 1) / 2 + offset
    places = torch.stack(torch.meshgrid(v, u, indexing="ij"), -1)
    origins = torch.cat([torch.zeros_like(places[..., :1]), places], -1)
    directions = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(origins)
    # a row vector times a rotation matrix is rotated back
    return origins @ turned[:, None], directions @ turned[:, None]


def march(volume: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
    """Line integrals along rays by Joseph's method in three dimensions (doi:10.1109/TMI.1982.4307572).

    There is one step for each layer of voxels perpendicular to the steepest axis of the ray, with interpolation between four
    voxels. Autograd provides the adjoint.

    Args:
        volume: (z, y, x) attenuation per voxel.
        origins, directions: (..., 3) voxels along (z, y, x) from the centre of the volume; the length of the direction is the
            unit of the integral.

    Returns:
        (...) integrals in the data type of the volume.

    Raises:
        ValueError: a direction has zero length, or shapes do not match.
    """
    if volume.ndim != 3 or origins.shape != directions.shape or origins.shape[-1] != 3:
        raise ValueError(
            f"march needs a volume (z, y, x) and rays (..., 3); got {tuple(volume.shape)}, {tuple(origins.shape)} and "
            f"{tuple(directions.shape)}"
        )
    start, along = origins.reshape(-1, 3).to(volume.device), directions.reshape(-1, 3).to(volume.device)
    steepness = along.abs()
    if not bool((steepness.amax(1) > 0).all()):
        raise ValueError("directions of rays must not have zero length")
    steepest = torch.tensor(_ORDER, device=volume.device)[steepness[:, list(_ORDER)].argmax(1)]
    sizes = torch.tensor(volume.shape, device=volume.device)
    integrals = volume.new_zeros(len(start))
    for axis, size in enumerate(volume.shape):
        level = torch.arange(size, device=volume.device) - (size - 1) / 2
        for part in torch.split((steepest == axis).nonzero()[:, 0], max(1, _AT_ONCE // size)):
            path = (level - start[part, axis, None]) / along[part, axis, None]
            points = start[part, None] + path[..., None] * along[part, None]
            relative = (2 * points / sizes).flip(-1)[None, None].to(volume)  # edges of the volume at ±1
            values = functional.grid_sample(volume[None, None], relative, align_corners=False)
            integrals = integrals.index_put((part,), values[0, 0, 0].sum(-1) / steepness[part, axis].to(volume))
    return integrals.view(origins.shape[:-1])


def _rotation(angle: NDArray[np.float64], plane: tuple[int, int], sense: int) -> NDArray[np.float64]:
    """(tilts, 3, 3) matrices that rotate the first of two axes (of z, y, x) towards the second, or away from it."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    first, second = plane
    matrix[:, first, first] = matrix[:, second, second] = np.cos(angle)
    matrix[:, first, second], matrix[:, second, first] = sense * np.sin(angle), -sense * np.sin(angle)
    return matrix
