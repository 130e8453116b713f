"""The distributions of the standard noise models: normal and Poisson."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import constraints

from noiseflow.distributions.electrons.contour import draw_poisson, log_poisson
from noiseflow.distributions.laws.base import DiscreteLevels, LatentDistribution, between, log_sum, near_level
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile
from noiseflow.distributions.numerics.normal import applied


class GaussianDistribution(LatentDistribution):
    """Normal distribution around the signal.

    Args:
        signal: detector units, any shape.
        log_scale: log of the standard deviation, a scalar.
    """

    per_pixel = ("signal",)

    def __init__(self, signal: Tensor, log_scale: Tensor) -> None:
        super().__init__(signal.shape, like=signal)
        self.signal, self.log_scale = self.clean(signal), self.working(log_scale)

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent = (value - self.signal) * torch.exp(-self.log_scale)
        return latent, -self.log_scale.expand_as(latent)

    def from_latent(self, latent: Tensor) -> Tensor:
        return self.signal + latent * torch.exp(self.log_scale)

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return torch.exp(2 * self.log_scale).expand_as(self.signal)


def gamma_mass(shape: Tensor, bound: Tensor, *, upper: bool) -> Tensor:
    """Probability of a gamma variable of this shape above or below a bound; differentiable in the bound in every mode."""
    found: Tensor = applied(_GammaMass, _GammaMassForward, shape, bound, upper)
    return found


class _GammaMass(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(shape: Tensor, bound: Tensor, upper: bool) -> Tensor:
        found: Tensor = torch.special.gammaincc(shape, bound) if upper else torch.special.gammainc(shape, bound)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.upper = inputs[2]
        ctx.save_for_backward(*inputs[:2])
        ctx.save_for_forward(*inputs[:2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, None]:
        return None, gradient * _gamma_slope(ctx), None


class _GammaMassForward(_GammaMass):
    """As `_GammaMass`, with the forward-mode derivatives that the functions of torch lack."""

    @staticmethod
    def jvp(ctx: Any, _: Any, tangent: Tensor, __: None) -> Tensor:
        return tangent * _gamma_slope(ctx)


def _gamma_slope(ctx: Any) -> Tensor:
    shape, bound = ctx.saved_tensors
    log_density: Tensor = torch.xlogy(shape - 1, bound) - bound - torch.lgamma(shape)
    return torch.exp(log_density) * (-1.0 if ctx.upper else 1.0)


class PoissonDistribution(NoiseDistribution):
    """Scaled and shifted Poisson distribution.

    Args:
        signal: detector units, any shape.
        gain, offset: numbers: counts per electron, and counts at zero dose.
    """

    has_rsample: ClassVar[bool] = False  # type: ignore[misc]
    discrete: ClassVar[bool] = True
    per_pixel = ("signal",)

    def __init__(self, signal: Tensor, gain: Tensor, offset: Tensor) -> None:
        super().__init__(signal.shape, like=signal)
        self.signal, self.gain, self.offset = self.clean(signal), self.working(gain), self.working(offset)

    @property
    def rate(self) -> Tensor:
        """Expected electrons, float64: at 10⁷ electrons, single precision would lose nine nats."""
        return ((self.signal.double() - self.offset) / self.gain).clamp(min=0)

    def _count(self, value: Tensor) -> Tensor:
        return ((value.double() - self.offset) / self.gain).detach()

    def _near(self, value: Tensor) -> Tensor:
        return near_level(value, self.offset.detach(), self.gain.detach())

    def log_prob(self, value: Tensor) -> Tensor:
        return self.log_masses(torch.round(self._count(value))) - torch.log(self.gain.double())

    def log_masses(self, count: Tensor) -> Tensor:
        """Log-probabilities of counts; −inf below 0."""
        rate = self.rate
        possible = (count == 0) | ((count > 0) & (rate > 0)) | torch.isnan(rate)
        count = torch.where(possible, count, torch.zeros_like(count)) + 0 * rate.detach()
        log_mass = log_poisson(count, rate)
        return torch.where(possible, log_mass, torch.full_like(log_mass, -math.inf))

    def cdf(self, value: Tensor) -> Tensor:
        return self._mass_up_to(torch.floor(self._count(value) + self._near(value)))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self._mass_up_to(torch.ceil(self._count(value) - self._near(value)) - 1)

    def _mass_up_to(self, count: Tensor, *, beyond: bool = False) -> Tensor:
        mass = gamma_mass((count + 1).clamp(min=1) + 0 * self.rate.detach(), self.rate + 0 * count, upper=not beyond)
        return torch.where(count >= 0, mass, torch.full_like(mass, float(beyond)))

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return between(self, *(torch.floor(self._count(bound) + self._near(bound)) for bound in (low, high)))

    def masses_up_to(self, count: Tensor, *, beyond: bool) -> Tensor:
        """P(k ≤ count), or P(k > count) if `beyond`; the count may be infinite."""
        finite = torch.isfinite(count)
        inside = self._mass_up_to(torch.where(finite, count, torch.zeros_like(count)), beyond=beyond)
        return torch.where(finite, inside, ((count > 0) != beyond).to(inside.dtype))

    def icdf(self, value: Tensor) -> Tensor:
        return self._value(torch.round(self._count(self._bisected(value))))

    def _bisected(self, value: Tensor) -> Tensor:
        rate = self.rate
        ends = torch.full_like(rate, -0.5), rate + 12 * (torch.sqrt(rate) + 1)
        return bisect_quantile(self.cdf, value, *(self._value(end.expand_as(value)) for end in ends))

    def _value(self, count: Tensor) -> Tensor:
        """Detector units, float64."""
        return count.double() * self.gain + self.offset

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self._value(self._poisson((*sample_shape, *self.batch_shape), generator))

    def _poisson(self, shape: tuple[int, ...], generator: torch.Generator | None) -> Tensor:
        return draw_poisson(self.rate.expand(shape), generator)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The offset and infinity."""
        return self.offset.detach(), torch.full_like(self.offset.detach(), math.inf)

    @property
    def support(self) -> constraints.Constraint:
        """Offset plus integer multiples of the gain."""
        gain, offset = float(self.gain.detach()), float(self.offset.detach())
        return DiscreteLevels(gain, offset, offset, math.inf)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        rate = self.rate.detach()
        most = rate + 12 * (torch.sqrt(rate) + 1)
        first = (rate - 12 * torch.sqrt(rate)).clamp(min=0).floor()
        count = torch.arange(int((most - first).max()) + 1 if rate.numel() else 1, device=rate.device)
        nodes = first + count.to(first).view(-1, *(1,) * rate.ndim)
        return self._value(nodes), torch.exp(self.log_masses(nodes))

    @property
    def mean(self) -> Tensor:
        return self._value(self.rate)

    @property
    def variance(self) -> Tensor:
        return self.rate * self.gain**2


class SpreadPoissonDistribution(PoissonDistribution):
    """Scaled and shifted Poisson distribution whose probabilities are spread evenly over cells as wide as the gain.

    Its density is that of `PoissonDistribution.log_prob`, also between the grid points, and its draws follow this density.
    Arguments as for `PoissonDistribution`.
    """

    discrete: ClassVar[bool] = False

    def _cells(self, value: Tensor) -> Tensor:
        """Number of cells below a value; the cell of k electrons lies between k and k + 1."""
        return self._count(value) + 0.5

    def cdf(self, value: Tensor) -> Tensor:
        cells = self._cells(value)
        whole = torch.floor(cells)
        part = torch.where(torch.isfinite(cells), cells - whole, torch.zeros_like(cells))
        inside = torch.where(torch.isfinite(whole), whole, torch.full_like(whole, -1.0))
        return self.masses_up_to(whole - 1, beyond=False) + part * torch.exp(self.log_masses(inside))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.cdf(value)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        first, last = self._cells(low), self._cells(high)
        left, right = torch.floor(first), torch.floor(last)
        within, ends = left == right, []
        for whole, share in ((left, torch.where(within, last - first, left + 1 - first)), (right, last - right)):
            possible = torch.isfinite(whole) & (share > 0)
            log_share = torch.log(torch.where(possible, share, torch.ones_like(share)))
            ends.append(log_share + self.log_masses(torch.where(possible, whole, torch.full_like(whole, -1.0))))
        ends[1] = torch.where(within, torch.full_like(ends[1], -math.inf), ends[1])
        return log_sum(torch.stack([*ends, between(self, left, torch.maximum(left, right - 1))]))

    def icdf(self, value: Tensor) -> Tensor:
        return self._bisected(value)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        count = self._poisson((*sample_shape, *self.batch_shape), generator)
        place = torch.rand(count.shape, generator=generator, dtype=count.dtype, device=count.device)
        return self._value(count + place - 0.5)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The lower edge of the cell of zero electrons, and infinity."""
        low, high = super().limits
        return low - 0.5 * self.gain.detach(), high

    @property
    def support(self) -> constraints.Constraint:
        """All values from the lower edge of the cell of zero electrons."""
        return constraints.greater_than_eq(float(self.limits[0]))  # type: ignore[no-untyped-call]

    def quadrature(self) -> tuple[Tensor, Tensor]:
        """Two Gauss–Legendre nodes in each cell, exact to the third moment."""
        nodes, weights = super().quadrature()
        apart = self.gain.detach() / (2 * math.sqrt(3.0))
        return torch.cat([nodes - apart, nodes + apart]), torch.cat([weights, weights]) / 2

    @property
    def variance(self) -> Tensor:
        return super().variance + self.gain**2 / 12
