"""Mean preservation of `PhysicsFlow`: the shift of its latent that cancels the effect of the flow on the mean."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from noiseflow.distributions.numerics.monotone_maps import Transform
from noiseflow.distributions.numerics.normal import normal_cdf
from noiseflow.distributions.numerics.table_axes import state_of
from noiseflow.models.flow import ConditionalFlow
from noiseflow.models.physical import PoissonGaussian
from noiseflow.models.physics_distribution import latent_nodes

_LEVELS = 81
_LEAST_LOG_RATE = -7.0
_MAX_STEPS = 20
_ALIKE = 40.0
_ALL, _FEW = slice(None), slice(None, None, 3)


class LatentMean:
    """Latent shifts at selected signals, cached while the detector and the range of signals do not change.

    With F(o) = Φ(T(z(o) − c)) the mean pixel value is o_last − ∫F do up to the last node. The detector's latent z(o) is computed
    once, on nodes fine enough for the read noise, and c by Newton's method. The signals are dense where the distribution changes
    fastest: logarithmically spaced just above the offset, and evenly spaced in the square root of the rate.
    """

    _shift: Tensor

    def __init__(self) -> None:
        self._laid_out: tuple[Any, ...] | None = None
        self._solved: tuple[Any, ...] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Excludes the cache, because its keys are memory addresses of parameters, which differ in a copy."""
        return {"_laid_out": None, "_solved": None}

    def __call__(self, signal: Tensor, detector: PoissonGaussian, correction: ConditionalFlow) -> Tensor:
        """Shifts at signals of any shape, float64; differentiable with respect to these and the parameters of `correction`."""
        self._lay_out(detector, correction)
        learning = torch.is_grad_enabled() and correction.bias.requires_grad
        if learning:
            knots, shift = self._rate[_FEW].contiguous(), self._solve(correction, _FEW)
        else:
            state = state_of(correction)
            if state != self._solved:
                with torch.no_grad():
                    self._shift = self._solve(correction, _ALL)
                self._solved = state
            knots, shift = self._rate, self._shift
        rate = (signal.double() - detector.offset.detach()) / detector.gain.detach()
        return interpolate_unequal(knots, shift, rate.clamp(float(knots[0]), float(knots[-1])))

    @torch.no_grad()
    def _lay_out(self, detector: PoissonGaussian, correction: ConditionalFlow) -> None:
        state = state_of(detector, *(float(b) for b in correction.standardisation.buffers() if b.ndim == 0))
        if state == self._laid_out:
            return
        gain, offset = detector.gain, detector.offset
        even = torch.linspace(0, 1, _LEVELS, dtype=torch.float64, device=gain.device)
        signals = (correction.standardisation.signal_at(even).double() - offset) / gain
        self._rate = _levels(signals, torch.sqrt(4 * signals[-1].clamp(min=0) + 9))
        signal = self._rate * gain + offset
        self._coordinate = correction.standardisation.coordinate(signal)[:, None].to(correction.bias.dtype)
        residual, self._latent = latent_nodes(detector(signal[:, None]))
        self._residual = residual
        self._shift = torch.zeros_like(self._rate)
        self._laid_out, self._solved = state, None

    def _solve(self, correction: ConditionalFlow, part: slice) -> Tensor:
        """Shifts at all levels with all nodes, or at some levels with some nodes; the last Newton step carries the gradient."""
        with torch.no_grad():
            maps = correction.transforms(self._coordinate[part])
            for _ in range(_MAX_STEPS):
                missing, slope = self._missing(maps, part)
                change = (missing / slope.clamp(min=1e-12)).clamp(-1, 1)
                self._shift[part] += change
                if float(change.abs().max()) < 1e-7:
                    break
        shift = self._shift[part].clone()
        if not torch.is_grad_enabled():
            return shift
        missing, slope = self._missing(correction.transforms(self._coordinate[part]), part)
        return shift + missing / slope.detach().clamp(min=1e-12)

    def _missing(self, maps: list[Transform], part: slice) -> tuple[Tensor, Tensor]:
        """Mean minus that of the detector, electrons, and its decrease with the shift, (G,) each."""
        residual = self._residual[part, part]
        mapped = self._latent[part, part] - self._shift[part, None]
        ladj = torch.zeros_like(mapped)
        for transform in maps:
            mapped, added = transform.forward(mapped)
            ladj = ladj + added
        density = torch.exp(ladj - mapped**2 / 2) / (2 * torch.pi) ** 0.5
        mean = residual[:, -1] - torch.trapezoid(normal_cdf(mapped), residual)
        return -mean, torch.trapezoid(density, residual)


def _levels(fitted: Tensor, root_of_most: Tensor) -> Tensor:
    """Rates, electrons, at which the shift is computed; negative ones are signals below the offset."""
    device = fitted.device
    dim = torch.logspace(_LEAST_LOG_RATE, 0, 41, dtype=torch.float64, device=device)
    bright = torch.linspace(1, float(root_of_most), _LEVELS, dtype=torch.float64, device=device) ** 2
    # the flow depends on the signal only inside the fitted range, which gives a corner at each end
    near = (fitted[-1] - fitted[0]) * torch.tensor([2e-4, 8e-4, 3e-3, 0.01], dtype=torch.float64, device=device)
    corners = [end + side * near for end in (fitted[0], fitted[-1]) for side in (-1, 1)]
    found: Tensor = torch.unique(torch.cat([fitted, fitted.new_zeros(1), dim, bright, *corners]))
    apart = torch.diff(found, prepend=found[:1] - 1) > 1e-5 * found.abs().clamp(min=10**_LEAST_LOG_RATE)
    return found[apart]


def interpolate_unequal(knots: Tensor, table: Tensor, at: Tensor) -> Tensor:
    """Interpolate (K,) values at increasing knots: by local cubics (four points) where gaps are similar, else linearly."""
    index = torch.searchsorted(knots, at.detach().contiguous()).clamp(2, knots.numel() - 2)
    near = [knots[index + k] for k in (-2, -1, 0, 1)]
    values = [table[index + k] for k in (-2, -1, 0, 1)]
    gap, beside = near[2] - near[1], torch.stack([near[1] - near[0], near[3] - near[2]])
    alike = (beside.amin(0) > gap / _ALIKE) & (beside.amax(0) < gap * _ALIKE)
    cubic = torch.zeros_like(at)
    for i, own in enumerate(near):
        term = values[i]
        for other in (*near[:i], *near[i + 1 :]):
            term = term * ((at - other) / (own - other))
        cubic = cubic + term
    # the outermost gaps have no neighbour on one side
    start = torch.where(at < near[1], 0, torch.where(at > near[2], 2, 1))
    low, high = (torch.stack(near[k : 3 + k]).gather(0, start[None])[0] for k in (0, 1))
    left, right = (torch.stack(values[k : 3 + k]).gather(0, start[None])[0] for k in (0, 1))
    found: Tensor = torch.where(alike & (start == 1), cubic, left + (right - left) * ((at - low) / (high - low)))
    return found
