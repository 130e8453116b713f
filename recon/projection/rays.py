"""Rays through a volume in any direction: x-tilt, dual axis, jitter. Slower than the slice operator; the results agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


def view_rays(
    views: NDArray[np.float64],
    *,
    height: int,
    width: int,
    offset: float = 0.0,
    jitter: Tensor | None = None,
    spread: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """One ray through every pixel of every view.

    Args:
        views: (tilts, 3, 3) from `view_matrices`.
        height, width: size of the detector, pixels.
        offset: position of the detector centre on the u axis, pixels.
        jitter: (tilt, v, u, 2) pixels along (v, u) from each pixel's centre.
        spread: (tilt, v, u, 2) slopes along (v, u), pixels per voxel of depth, about the focal plane through the centre.

    Returns:
        Origins and directions, (tilt, v, u, 3) each, voxels along (z, y, x) from the centre of the volume. Directions have a
        length of one voxel along the beam.
    """
    turned = torch.from_numpy(np.asarray(views, dtype=np.float64))
    v = torch.arange(height, dtype=torch.float64) - (height - 1) / 2
    u = torch.arange(width, dtype=torch.float64) - (width - 1) / 2 + offset
    places = torch.stack(torch.meshgrid(v, u, indexing="ij"), -1).expand(len(turned), -1, -1, -1)
    places = places if jitter is None else places + jitter.double()
    slopes = torch.zeros_like(places) if spread is None else spread.double()
    origins = torch.cat([torch.zeros_like(places[..., :1]), places], -1)
    directions = torch.cat([torch.ones_like(slopes[..., :1]), slopes], -1)
    back = turned[:, None]  # a row vector times a rotation matrix is rotated back
    return origins @ back, directions @ back


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
    integrals = volume.new_zeros(len(start))
    for axis in range(3):
        chosen = (steepest == axis).nonzero()[:, 0]
        layers, order = volume.movedim(axis, 0), [axis, *(other for other in range(3) if other != axis)]
        for part in torch.split(chosen, max(1, _AT_ONCE // volume.shape[axis])):
            sums = _march_across(layers, start[part][:, order], along[part][:, order])
            integrals = integrals.index_put((part,), sums)
    return integrals.view(origins.shape[:-1])


def _march_across(layers: Tensor, start: Tensor, along: Tensor) -> Tensor:
    """Integrate along rays with their steepest axis first, through layers (steepest, row, column) of voxels."""
    count, *sides = layers.shape
    flat = layers.reshape(-1)
    level = torch.arange(count, device=start.device) - (count - 1) / 2
    path = (level - start[:, :1]) / along[:, :1]
    crossing = [start[:, [k]] + path * along[:, [k]] + (side - 1) / 2 for k, side in enumerate(sides, 1)]
    first = [place.floor() for place in crossing]
    total = flat.new_zeros(len(start))
    for down in (0, 1):
        for right in (0, 1):
            near = first[0] + down, first[1] + right
            share = (1 - (crossing[0] - near[0]).abs()) * (1 - (crossing[1] - near[1]).abs())
            inside = (near[0] >= 0) & (near[0] < sides[0]) & (near[1] >= 0) & (near[1] < sides[1])
            rows, columns = near[0].clamp(0, sides[0] - 1).long(), near[1].clamp(0, sides[1] - 1).long()
            index = (torch.arange(count, device=start.device) * sides[0] + rows) * sides[1] + columns
            total = total + (flat[index] * (share * inside).to(flat.dtype)).sum(1)
    return total / along[:, 0].abs().to(flat.dtype)


def _rotation(angle: NDArray[np.float64], plane: tuple[int, int], sense: int) -> NDArray[np.float64]:
    """(tilts, 3, 3) matrices that rotate the first of two axes (of z, y, x) towards the second, or away from it."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    first, second = plane
    matrix[:, first, first] = matrix[:, second, second] = np.cos(angle)
    matrix[:, first, second], matrix[:, second, first] = sense * np.sin(angle), -sense * np.sin(angle)
    return matrix
