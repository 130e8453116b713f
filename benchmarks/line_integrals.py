"""Would a fit of Gaussians gain by their line integrals, without voxels between? The work of both ways, side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.scenes import Cell, Scene
from recon.fields.kinds.gaussians import GaussianField, rotations
from recon.joint.joint import JointReconstructor
from recon.projection.projector import SliceProjector

_REACH = 3.0  # standard deviations, as for voxels
_REPEATS = 5


def compare_ways(scene: Scene) -> Cell:
    """Fit Gaussians to a scene; then seconds of its projections, median of five, by voxels and by 2D Gaussians in every image.

    The integral of a 3D Gaussian along a ray is a 2D Gaussian of the image (Zwicker et al., EWA splatting, 2002).
    """
    torch.set_num_threads(1)
    field = JointReconstructor(noise_model=lambda: scene.noise_model, make_field=GaussianField)(scene.noisy).field
    assert isinstance(field, GaussianField)
    angles = scene.noisy.tilt_angles
    projector = SliceProjector(tilt_angles=angles, depth=field.depth, width=field.width)

    def by_voxels() -> Tensor:
        return projector.project(field.volume().transpose(1, 2).reshape(-1, field.height))

    with torch.no_grad():
        voxels, rays = _seconds(by_voxels)
        direct, (images, count) = _seconds(lambda: line_integrals(field, np.deg2rad(angles)))
    expected = rays.view(len(angles), field.width, field.height).transpose(1, 2)
    return {
        "tilts": len(angles),
        "seconds by voxels": voxels,
        "seconds without": direct,
        "exponentials without": count,
        "relative difference": float((images - expected).norm() / expected.norm()),
    }


def line_integrals(field: GaussianField, angles: Any) -> tuple[Tensor, int]:
    """Projections (tilt, y, u) of the Gaussians, and how often an exponential was evaluated."""
    width, axes = field.standard_deviations(), rotations(field.rotation)
    covariance, peak = (axes * width[:, None] ** 2) @ axes.mT, functional.softplus(field.peak)
    middle = (torch.tensor([field.depth, field.height, field.width]) - 1) / 2
    margin = math.ceil(_REACH * float(width.max()))
    images, count = torch.zeros(len(angles), field.height + 2 * margin, field.width + 2 * margin), 0
    for image, angle in zip(images, angles, strict=True):
        across = torch.tensor([[0.0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])  # (y, u) of (z, y, x)
        flat = across @ covariance @ across.mT
        along = (2 * math.pi * torch.linalg.det(covariance) / torch.linalg.det(flat)).sqrt()
        centre = (field.centre - middle) @ across.T + middle[1:] + margin
        centre, precision = centre.clamp(margin, min(image.shape) - 1 - margin), torch.linalg.inv(flat)
        radius = (_REACH * torch.diagonal(flat, dim1=1, dim2=2).amax(1).sqrt()).round().long().clamp_max(margin)
        for size in torch.unique(radius).tolist():
            chosen = (radius == size).nonzero()[:, 0]
            span = torch.arange(-size, size + 1)
            y, u = (each.reshape(-1) for each in torch.meshgrid(span, span, indexing="ij"))
            terms = torch.stack([torch.ones_like(y), y, u, y * y, u * u, y * u]).float()
            nearest = centre[chosen].round()
            shift, p = nearest - centre[chosen], precision[chosen]
            linear = (p @ shift[..., None])[..., 0]
            constant = (peak * along)[chosen].log() - 0.5 * (linear * shift).sum(-1)
            square = -0.5 * torch.diagonal(p, dim1=1, dim2=2)
            values = torch.exp_(torch.cat([constant[:, None], -linear, square, -p[:, :1, 1]], 1) @ terms)
            stride = torch.tensor(image.stride())
            places = (nearest.long() * stride).sum(-1)[:, None] + y * stride[0] + u
            image.view(-1).index_add_(0, places.view(-1), values.view(-1))
            count += values.numel()
    return field.scale * images[:, margin:-margin, margin:-margin], count


def _seconds(function: Callable[[], Any]) -> tuple[float, Any]:
    found = []
    for _ in range(_REPEATS):
        started = time.process_time()
        result = function()
        found.append(time.process_time() - started)
    return float(np.median(found)), result
