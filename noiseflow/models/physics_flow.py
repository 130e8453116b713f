"""Physical noise model with a flow: exact shot and read noise, and a smooth map of its latent for deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.electrons.exact import log_density, log_tail
from noiseflow.distributions.laws.poisson_gaussian import PoissonGaussianDistribution, in_electrons
from noiseflow.distributions.noise_distribution import TOGETHER, NoiseDistribution, of_finite
from noiseflow.distributions.numerics.elementwise import compilable, pixelwise
from noiseflow.distributions.numerics.monotone_maps import AFFINE, Transform, back_through, spline_layer, through
from noiseflow.distributions.numerics.normal import (
    FARTHEST,
    LOG_SQRT_2PI,
    log_normal_cdf,
    log_normal_interval,
    normal_cdf,
    normal_hazard,
)
from noiseflow.distributions.numerics.tables import moments
from noiseflow.distributions.pixels import is_traced
from noiseflow.models.base import Behind, NoiseModelBase
from noiseflow.models.flow import ConditionalFlow
from noiseflow.models.physical import PoissonGaussian


class PhysicsFlow(NoiseModelBase):
    """Poisson–Gaussian noise, corrected by a flow of its latent.

    The latent of an observation under the detector, z = Φ⁻¹(F(o | s)), is standard normal if the detector describes the noise
    completely. A conditional affine map and spline, initially the identity, map it to z′, the standard normal latent of this
    model: log p = log p_detector + log φ(z′) + log dz′/dz − log φ(z). Peaks of single electrons keep their positions.

    A fit first finds the detector by maximum likelihood and keeps it fixed while the flow is trained. The detector's part of the
    likelihood of each pixel is then computed only once.

    Args:
        num_bins: number of bins of the spline.
        width: hidden units of the conditioning network.
        detector: the physical part; by default a `PoissonGaussian`.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.PhysicsFlow()
        >>> noise(torch.tensor([0.2, 0.8])).log_prob(torch.tensor([0.25, 0.75])).shape
        torch.Size([2])
    """

    most_joint_steps = PoissonGaussian.most_joint_steps
    fits_directly = True
    settles = True
    costly = True
    settings = ("num_bins", "width")

    def __init__(self, num_bins: int = 16, *, width: int = 32, detector: PoissonGaussian | None = None) -> None:
        super().__init__()
        check(num_bins=num_bins, width=width)
        self.num_bins, self.width = num_bins, width
        self.detector = (PoissonGaussian() if detector is None else detector).requires_grad_(False)
        self.correction = ConditionalFlow([AFFINE, spline_layer(num_bins)], width=width)

    def forward(self, signal: Tensor) -> PhysicsFlowDistribution:
        return PhysicsFlowDistribution(self.detector(signal), self._maps, model=self)

    def _maps(self, signal: Tensor) -> list[Transform]:
        coordinate = self.correction.standardisation.coordinate(signal)
        with torch.autocast(signal.device.type, enabled=False):
            return self.correction.transforms(coordinate)

    def standardise(self, signal: Tensor, observation: Tensor, *, settle: bool = True) -> None:
        """Find the maximum-likelihood detector for (N,) signals and observations."""
        self.detector.standardise(signal, observation, settle=settle)
        self.correction.standardise(signal, observation)

    def settle(self, signal: Tensor, observation: Tensor, behind: Behind | None = None) -> None:
        """Set the detector to its maximum-likelihood parameters; see `PoissonGaussian.settle`."""
        self.detector.settle(signal, observation, behind)

    @torch.no_grad()
    def fixed_part(self, signal: Tensor, observation: Tensor, upto: Tensor | None = None) -> Tensor:
        """The part of the likelihood that training the flow does not change: (N, 2) of pixels, (N, 3) of intervals."""
        law = self.forward(signal)
        return torch.stack(law.detector_part(observation) if upto is None else law.interval_part(observation, upto), -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels or intervals from their `fixed_part`."""
        latent, *more = fixed_part.unbind(-1)
        law = self.forward(signal)
        found = law.corrected_interval(latent, *more) if len(more) > 1 else more[0] + law.correct(latent)[1]
        return found.to(signal.dtype)


class PhysicsFlowDistribution(NoiseDistribution):
    """A Poisson–Gaussian distribution whose latent is transformed by monotone maps; computed in float64.

    Args:
        base: the distribution of the detector.
        maps: function from signals to the increasing maps from the detector's latent to that of this model, in order.
        model: the `PhysicsFlow`, for the tables of large inputs.
    """

    per_pixel = ()

    def __init__(
        self, base: PoissonGaussianDistribution, maps: Callable[[Tensor], Sequence[Transform]], *, model: nn.Module
    ) -> None:
        super().__init__(base.batch_shape, like=torch.empty(0, dtype=base.dtype, device=base.device))
        self.base, self._maps, self._model = base, maps, model

    @property
    def source(self) -> tuple[nn.Module, Tensor] | None:
        """The model and the signal."""
        return self._model, self.base.signal

    @property
    def _transforms(self) -> Sequence[Transform]:
        return self.once(lambda: self._maps(self.base.signal))

    def correct(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """The transformed latent, and the log-density of this model minus that of the detector."""
        mapped, gain = through(self._transforms, latent)
        return mapped, gain + (latent - mapped) * (latent + mapped) / 2

    def _detector_latent(self, value: Tensor) -> Tensor:
        return of_finite(lambda each: pixelwise(_latent, each, *self.base.law), value)

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The latent of an observation and its log-derivative, ``(z, log dz/do)``."""
        latent, _ = self.correct(self._detector_latent(value))
        return latent.to(value.dtype), (self._log_prob(value) + 0.5 * latent**2 + LOG_SQRT_2PI).to(value.dtype)

    @torch.no_grad()
    def from_latent(self, latent: Tensor) -> Tensor:
        """The observation of a latent."""
        return self._invert(back_through(self._transforms, latent.double())).to(latent.dtype)

    def _invert(self, target: Tensor) -> Tensor:
        rate = self.base.rate.expand_as(target)
        nothing = torch.isnan(rate + target)
        known = [torch.where(nothing, torch.zeros_like(each), each).flatten() for each in (target, rate)]
        residual = invert_latent(known[0], known[1], self.base.read_noise).reshape(target.shape)
        residual = torch.where(nothing, torch.full_like(residual, math.nan), residual)
        return residual * self.base.gain + self.base.mean.double()

    def detector_part(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The detector's latent and log-density."""
        return self._detector_latent(value), self.base.log_prob(value.double())

    def _log_prob(self, value: Tensor) -> Tensor:
        latent, density = self.detector_part(value)
        return density + self.correct(latent)[1]

    def log_prob(self, value: Tensor) -> Tensor:
        return self._log_prob(value)

    def cdf(self, value: Tensor) -> Tensor:
        return normal_cdf(self._mapped_bound(self._detector_latent(value))).to(value.dtype)

    def _mapped_bound(self, latent: Tensor) -> Tensor:
        return of_finite(lambda each: self.correct(each)[0], latent)

    def interval_part(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The detector's latents at both ends and its log-probability between them."""
        mass = self.base.log_interval_prob(low.double(), high.double())
        return self._detector_latent(low), self._detector_latent(high), mass

    def corrected_interval(self, bottom: Tensor, top: Tensor, mass: Tensor) -> Tensor:
        """The detector's exact probability times the mean correction, accurate even for tiny probabilities."""
        zero = torch.zeros_like(bottom)
        empty = bottom == top  # also at infinite ends
        bottom, top = torch.where(empty, zero, bottom), torch.where(empty, zero, top)
        narrow = top - bottom < 1e-3
        ends = torch.stack([torch.where(narrow, zero - 1, bottom), torch.where(narrow, zero + 1, top)])
        wide = log_normal_interval(*self._mapped_bound(ends)) - log_normal_interval(*ends)
        if not is_traced(narrow) and not bool(narrow.any()):
            return mass + wide
        at_middle = self.correct(torch.where(narrow, (bottom + top) / 2, zero))[1]
        return mass + torch.where(narrow, at_middle, wide)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.corrected_interval(*self.interval_part(low, high)).to(low.dtype)

    def icdf(self, value: Tensor) -> Tensor:
        return self.from_latent(torch.special.ndtri(value.double())).to(value.dtype)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        signal = self.base.signal
        shape = (*sample_shape, *self.batch_shape)
        return self.from_latent(torch.randn(shape, generator=generator, dtype=signal.dtype, device=signal.device))

    @property
    def mean(self) -> Tensor:
        return self.once(self._moments)[0]

    @property
    def variance(self) -> Tensor:
        return self.once(self._moments)[1]

    def _moments(self) -> tuple[Tensor, Tensor]:
        signal = self.base.signal
        shift, width = (
            each.reshape(self.batch_shape) for each in moments(self._model, signal.reshape(-1), self._exact)
        )
        return (signal.double() + shift).to(signal.dtype), (width**2).to(signal.dtype)

    def _exact(self, signal: Tensor) -> tuple[Tensor, Tensor]:
        """Mean minus signal and standard deviation, (N,) each, from integrals of the CDF over nodes as fine as the read noise."""
        parts, gain = [], self.base.gain.detach()
        for part in torch.split(signal, TOGETHER):
            distribution = self._model(part[:, None])
            residual, latent = latent_nodes(distribution.base)
            below = normal_cdf(distribution.correct(latent)[0])
            mean = residual[:, -1] - torch.trapezoid(below, residual)
            about = residual - mean[:, None]
            square = about[:, -1] ** 2 - 2 * torch.trapezoid(about * below, residual)
            parts.append((gain * mean, gain * torch.sqrt(square)))
        shift, width = (torch.cat(each) for each in zip(*parts, strict=True))
        return shift, width


@compilable
def _latent(
    value: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, *, twice: bool = False
) -> Tensor:
    residual, rate = in_electrons(value, signal, gain, offset)
    return detector_latent(residual, rate, read_noise, twice=twice)


@torch.no_grad()
def latent_nodes(
    base: PoissonGaussianDistribution, *, centre: float = 7.0, least: int = 768, most: int = 2560, tail: int = 40
) -> tuple[Tensor, Tensor]:
    """Residuals, electrons, that cover the pixel values of signals (G, 1) with the spacing of the read noise, and their latents.

    The nodes of a row, from `least` to `most`, are equally spaced up to the latents ±`centre`; each far tail, which matters only
    if the flow widens it, has `tail` more.

    Returns:
        Two (G, K) tensors, float64.
    """
    rate = base.rate[:, 0]
    ends = [invert_latent(torch.full_like(rate, end), rate, base.read_noise) for end in (-FARTHEST, FARTHEST)]
    low, high = (invert_latent(torch.full_like(rate, end), rate, base.read_noise) for end in (-centre, centre))
    count = float((high - low).max() / (0.4 * base.read_noise)) if rate.numel() else 0.0
    count = int(min(max(count, least), most))
    fraction = torch.linspace(0, 1, count, dtype=torch.float64, device=rate.device)
    away = torch.linspace(0, 1, tail + 1, dtype=torch.float64, device=rate.device)[1:] ** 2
    below, above = (edge[:, None] + (end - edge)[:, None] * away for edge, end in zip((low, high), ends, strict=True))
    residual = torch.cat([below.flip(1), low[:, None] + (high - low)[:, None] * fraction, above], 1)
    return residual, detector_latent(residual, rate[:, None].expand_as(residual), base.read_noise)


def detector_latent(residual: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False) -> Tensor:
    """Φ⁻¹(P(pixel value ≤ residual)) for residuals in electrons."""
    side = torch.where(residual.detach() > 0, -1.0, 1.0).to(residual)
    return side * ndtri_exp(log_tail(residual, rate, read_noise, twice=twice), twice=twice)


@torch.no_grad()
def invert_latent(target: Tensor, rate: Tensor, read_noise: Tensor, *, num_steps: int = 80) -> Tensor:
    """The residual, electrons, whose detector latent is `target`, by Newton's method with bracketing bounds; (N,)."""
    spread, size = torch.sqrt(rate) + read_noise + 1, target.abs() + 3
    low, high = -spread * size, spread * size + size**2
    result = residual = torch.sqrt(rate + read_noise**2) * target
    left = torch.arange(target.numel(), device=target.device)
    for step in range(num_steps):
        latent = detector_latent(residual, rate, read_noise)
        above = latent >= target
        low, high = torch.where(above, low, residual), torch.where(above, residual, high)
        result = result.index_put((left,), residual)
        log_slope = log_density(residual, rate, read_noise) + 0.5 * latent**2 + LOG_SQRT_2PI
        newton = residual - (latent - target) * torch.exp(-log_slope)
        residual = torch.where((newton > low) & (newton < high) & (step % 4 != 3), newton, (low + high) / 2)
        going = ((latent - target).abs() > 1e-9) & (high - low > 1e-12 * spread)
        if not bool(going.any()):
            break
        left, target, rate, residual, low, high, spread = (
            each[going] for each in (left, target, rate, residual, low, high, spread)
        )
    return result


def ndtri_exp(log_probability: Tensor, *, twice: bool = False) -> Tensor:
    """Φ⁻¹(exp(log_probability)), accurate and differentiable for tiny probabilities; second derivatives only if `twice`."""
    with torch.no_grad():
        deep = log_probability < -200
        far = torch.where(deep, -2 * log_probability, torch.full_like(log_probability, 400.0))
        start = torch.special.ndtri(torch.exp(torch.where(deep, -1.0, log_probability)))
        z = torch.where(deep, -torch.sqrt(far - torch.log(2 * math.pi * far)), start)
        z = z - (log_normal_cdf(z) - log_probability) / normal_hazard(z)
        if not twice:
            hazard = normal_hazard(z)
    if not twice:
        return z - (log_normal_cdf(z) - log_probability) / hazard
    # the first step carries the slope, the second the curvature
    z = z - (log_normal_cdf(z) - log_probability) / normal_hazard(z)
    return z - (log_normal_cdf(z) - log_probability) / normal_hazard(z)
