"""SIRT and weighted back-projection: reconstructions from the operator alone."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor
from recon.projection.base import Projector


def sirt(
    line_integrals: Given,
    projector: Projector,
    *,
    num_iterations: int = 100,
    start: Given | None = None,
    used: Given | None = None,
) -> Given:
    """Reconstruct by x ← x + C Aᵀ R (y − A x), with R and C the inverse row and column sums of A, and negative x set to 0.

    The simultaneous iterative technique (doi:10.1016/0022-5193(72)90180-4), in its modern weighted form.

    Args:
        line_integrals: (tilt, y, u) measured line integrals, a tensor or an array.
        projector: the operator A.
        num_iterations: number of iterations; noise increases with it.
        start: (z, y, x) initial volume; zero if None. Thirty iterations are equivalent to ten followed by twenty.
        used: (tilt, y, u) weights, 1 for pixels to use and 0 for the others; None for all.

    Returns:
        (z, y, x) attenuation per voxel, of the same array type as the input.

    Example:
        >>> import recon, torch
        >>> A = recon.SliceProjector(tilt_angles=range(-90, 90, 10), depth=8, width=8)
        >>> volume = torch.zeros(8, 2, 8)
        >>> volume[3:5, :, 3:5] = 1.0
        >>> found = recon.sirt(A(volume), A, num_iterations=30)
        >>> bool((found - volume).abs().mean() < 0.1)
        True
    """
    A = projector
    y = as_tensor(line_integrals, like=A)
    R = _inverse(A(torch.ones((A.depth, A.fixed_height or 1, A.width), dtype=y.dtype, device=y.device)))
    weights = torch.ones_like(R) if used is None else as_tensor(used, like=A)
    R, C = R * weights, _inverse(A.T(weights))
    empty = torch.zeros((A.depth, y.shape[1], A.width), dtype=y.dtype, device=y.device)
    x = empty if start is None else as_tensor(start, like=A)
    for _ in range(num_iterations):
        x = (x + C * A.T(R * (y - A(x)))).clamp_min(0)
    return alike(x, line_integrals)


def _inverse(sums: Tensor) -> Tensor:
    return torch.where(sums > 0, 1 / sums, torch.zeros_like(sums))


WINDOWS: dict[str, Callable[[Tensor], Tensor]] = {
    "ramp": torch.ones_like,
    "shepp-logan": lambda share: torch.sinc(share / 2),
    "cosine": lambda share: torch.cos(math.pi / 2 * share),
    "hamming": lambda share: 0.54 + 0.46 * torch.cos(math.pi * share),
    "hann": lambda share: 0.5 + 0.5 * torch.cos(math.pi * share),
}
"""Window functions by name; their argument is frequency over cutoff, in [0, 1]."""


def wbp(line_integrals: Given, projector: Projector, *, window: str = "ramp", cutoff: float = 1.0) -> Given:
    """Reconstruct by a ramp filter and one back-projection (Kak & Slaney 1988, doi:10.1137/1.9780898719277).

    The ramp is the Fourier transform of the band-limited kernel of Ramachandran and Lakshminarayanan, which preserves constants.
    Each tilt is weighted by its angular share.

    Args:
        line_integrals: (tilt, y, u), a tensor or an array.
        projector: the operator whose adjoint back-projects.
        window: one of `WINDOWS`; it reduces high-frequency noise.
        cutoff: fraction of the Nyquist frequency above which frequencies are removed.

    Returns:
        (z, y, x) attenuation per voxel, not clamped, of the same array type as the input.

    Raises:
        ValueError: the window is unknown, or the cutoff is outside (0, 1].

    Example:
        >>> import recon, torch
        >>> A = recon.SliceProjector(tilt_angles=range(-90, 90, 10), depth=8, width=8)
        >>> recon.wbp(A(torch.ones(8, 2, 8)), A).shape
        torch.Size([8, 2, 8])
    """
    if window not in WINDOWS:
        raise ValueError(f"window '{window}': choose one of {', '.join(WINDOWS)}")
    if not 0 < cutoff <= 1:
        raise ValueError(f"cutoff {cutoff} must be above 0 and at most 1, a fraction of the Nyquist frequency")
    images = as_tensor(line_integrals, like=projector)
    count = images.shape[-1]
    padded = 2 ** math.ceil(math.log2(2 * count))
    response = _filter(padded, window, cutoff, like=images)
    filtered = torch.fft.irfft(torch.fft.rfft(images, n=padded) * response, n=padded)[..., :count]
    shares = torch.as_tensor(angular_shares(projector.tilt_angles), dtype=filtered.dtype, device=filtered.device)
    return alike(projector.T((filtered * shares[:, None, None]).contiguous()), line_integrals)


def directions(tilt_angles: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Sorted different directions within [0°, 180°), the index of that of each tilt, and the step from each to the next."""
    values, back = np.unique(np.round(np.asarray(tilt_angles, np.float64) % 180, 6) % 180, return_inverse=True)
    return values, back, np.diff(np.r_[values, values[0] + 180])


def angular_shares(tilt_angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The angular share (radians) of each tilt: half the distance to each neighbour; at the ends as much as inside.

    Directions are taken modulo 180°. The largest gap is the missing wedge, which belongs to no tilt.
    """
    values, back, after = directions(tilt_angles)
    if values.size == 1:
        return np.full(back.shape, math.pi / back.size)
    before, wedge = np.roll(after, 1), int(after.argmax())
    first = (wedge + 1) % values.size
    left, right = before.copy(), after.copy()
    left[first], right[wedge] = after[first], before[wedge]
    return np.asarray((np.deg2rad((left + right) / 2) / np.bincount(back))[back])


def _filter(padded: int, window: str, cutoff: float, *, like: Tensor) -> Tensor:
    index = torch.arange(padded, dtype=torch.float64)
    distance = torch.minimum(index, padded - index)
    kernel = torch.where(distance % 2 == 1, -1 / (math.pi * distance.clamp_min(1)) ** 2, torch.zeros(()).double())
    kernel[0] = 0.25
    ramp: Tensor = torch.fft.rfft(kernel).real
    share = torch.linspace(0, 1, len(ramp), dtype=torch.float64) / cutoff
    return (ramp * torch.where(share <= 1, WINDOWS[window](share), 0.0)).to(dtype=like.dtype, device=like.device)
