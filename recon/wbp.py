"""Weighted back-projection: a ramp filter and one back-projection (Kak & Slaney 1988, doi:10.1137/1.9780898719277)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from recon.projector import SliceProjector


def wbp(line_integrals: Tensor, projector: SliceProjector, *, cutoff: float = 1.0) -> Tensor:
    """Reconstruct by filtered back-projection.

    The ramp is the transform of the band-limited kernel of Ramachandran and Lakshminarayanan, so that constants are
    kept; each tilt weighs as much as the angle it stands for.

    Args:
        line_integrals: (tilt, y, u).
        projector: the operator whose adjoint back-projects.
        cutoff: fraction of the Nyquist frequency at which a cosine window ends; 1 or more leaves the ramp alone.

    Returns:
        (z, y, x) attenuation per voxel, not clamped.

    Raises:
        ValueError: a cutoff that is not positive.
    """
    if not cutoff > 0:
        raise ValueError(f"cutoff {cutoff} must be positive")
    count = line_integrals.shape[-1]
    padded = 2 ** math.ceil(math.log2(2 * count))
    response = _ramp(padded, cutoff, like=line_integrals)
    filtered = torch.fft.irfft(torch.fft.rfft(line_integrals, n=padded) * response, n=padded)[..., :count]
    shares = torch.as_tensor(angular_shares(projector.tilt_angles), dtype=filtered.dtype, device=filtered.device)
    return projector.T((filtered * shares[:, None, None]).contiguous())


def angular_shares(
    tilt_angles: np.ndarray[tuple[int], np.dtype[np.float64]],
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """The angle (radians) that each tilt stands for: half the way to each neighbour, at the ends as much as inside."""
    theta = np.deg2rad(np.asarray(tilt_angles, dtype=np.float64))
    values, back, counts = np.unique(theta, return_inverse=True, return_counts=True)
    steps = np.diff(values)
    if steps.size == 0:
        return np.full(theta.shape, math.pi / theta.size)
    left, right = np.r_[steps[0], steps], np.r_[steps, steps[-1]]
    shares = (left + right) / 2
    shares *= min(1.0, math.pi / shares.sum())
    return np.asarray((shares / counts)[back])


def _ramp(padded: int, cutoff: float, *, like: Tensor) -> Tensor:
    index = torch.arange(padded, dtype=torch.float64)
    distance = torch.minimum(index, padded - index)
    kernel = torch.where(distance % 2 == 1, -1 / (math.pi * distance.clamp_min(1)) ** 2, torch.zeros(()).double())
    kernel[0] = 0.25
    response: Tensor = torch.fft.rfft(kernel).real
    frequency = torch.linspace(0, 1, len(response), dtype=torch.float64)
    if cutoff < 1:
        response = response * torch.where(frequency < cutoff, torch.cos(math.pi / 2 * frequency / cutoff) ** 2, 0.0)
    return response.to(dtype=like.dtype, device=like.device)
