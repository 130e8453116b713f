"""The distribution of shot plus read noise, in detector units."""

import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from noiseflow.distributions.electrons.contour import draw_poisson, log_poisson
from noiseflow.distributions.electrons.exact import RESOLVED, below, interval_and_slopes, log_density, log_interval
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile
from noiseflow.distributions.numerics.elementwise import compilable, pixelwise
from noiseflow.distributions.numerics.normal import normal_quadrature


def _by_read_noise(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Decorator for elementwise functions that splits a call by read noise, the last argument: pixels that resolve electrons use
    the sum, the others the contour integral."""

    @functools.wraps(function)
    def parted(*inputs: Tensor, twice: bool = False) -> Tensor:
        resolved = inputs[-1].detach() < RESOLVED
        if bool(resolved.all()) or not bool(resolved.any()):
            return function(*inputs, twice=twice)
        parts = [
            function(*(each[chosen] if each.ndim else each for each in inputs), twice=twice)
            for chosen in (resolved, ~resolved)
        ]
        found = torch.zeros_like(inputs[-1], dtype=parts[0].dtype)
        return found.masked_scatter(resolved, parts[0]).masked_scatter(~resolved, parts[1])

    return compilable(parted)


def in_electrons(value: Tensor, signal: Tensor, gain: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Residual and rate, electrons, of equal shape; one of value and signal may be a scalar."""
    residual = (value - signal) / gain
    return residual, ((signal - offset).clamp(min=0) / gain).expand_as(residual)


@_by_read_noise
def _log_density(
    value: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, *, twice: bool = False
) -> Tensor:
    return log_density(*in_electrons(value, signal, gain, offset), read_noise) - torch.log(gain)


@_by_read_noise
def _log_interval(
    low: Tensor, high: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, *, twice: bool = False
) -> Tensor:
    return log_interval(*_bounds(low, high, signal, gain, offset, read_noise), read_noise, twice=twice)


def _bounds(
    low: Tensor, high: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals of the bounds and rates, electrons; infinite bounds are replaced by finite ones beyond all probability."""
    (bottom, rate), (top, _) = (in_electrons(value, signal, gain, offset) for value in (low, high))
    finite = torch.isfinite(low), torch.isfinite(high)
    if bool((finite[0] & finite[1]).all()):
        return bottom, top, rate
    (bottom, _), (top, _) = (
        in_electrons(torch.where(known, value, torch.zeros_like(value)), signal, gain, offset)
        for known, value in zip(finite, (low, high), strict=True)
    )
    end = (40 * torch.sqrt(rate + read_noise**2) + 100).detach()
    least = torch.where(finite[1], torch.minimum(top.detach() - end, -end), -end)
    most = torch.where(finite[0], torch.maximum(bottom.detach() + end, end), end)
    bottom = torch.where(finite[0], bottom, torch.where(low > 0, most, least))
    top = torch.where(finite[1], top, torch.where(high > 0, most, least))
    return bottom, top, rate


def _interval_and_slopes(
    low: Tensor, high: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Log-probability of an interval and its derivatives, by the chain rule from electrons to detector units."""
    bottom, top, rate = _bounds(low, high, signal, gain, offset, read_noise)
    value, found = interval_and_slopes(bottom, top, rate, read_noise, slopes=slopes)
    if not slopes:
        return value, ()
    of_low, of_high, of_rate, of_noise = found
    of_low, of_high = (
        torch.where(torch.isfinite(bound), slope / gain, torch.zeros_like(slope))
        for bound, slope in ((low, of_low), (high, of_high))
    )
    of_rate = torch.where(signal > offset, of_rate / gain, torch.zeros_like(of_rate))
    of_gain = -(bottom * of_low + top * of_high + rate * of_rate)
    return value, (of_low, of_high, of_rate - of_low - of_high, of_gain, -of_rate, of_noise)


@_by_read_noise
def _below(
    value: Tensor, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, *, twice: bool = False
) -> Tensor:
    return below(*in_electrons(value, signal, gain, offset), read_noise, twice=twice)


class PoissonGaussianDistribution(NoiseDistribution):
    """Distribution of gain·(k + read_noise·n) + offset, k Poisson of rate (signal − offset)/gain, n standard normal.

    Args:
        signal: clean pixel values, detector units, any shape.
        gain, offset: scalars, float64: counts per electron, counts.
        read_noise: electrons rms, float64: a scalar, or one for each pixel.
    """

    light = True  # derivatives are stored instead of a graph

    def __init__(self, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor) -> None:
        super().__init__(signal.shape, like=signal)
        self.per_pixel = ("signal", "read_noise") if read_noise.ndim else ("signal",)  # type: ignore[misc]
        self.signal, self.gain, self.offset, self.read_noise = self.clean(signal), gain, offset, read_noise

    @property
    def law(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Arguments of elementwise functions after the observation: signal, gain, offset, read noise."""
        return self.signal, self.gain, self.offset, self.read_noise

    @property
    def rate(self) -> Tensor:
        """Expected electrons, float64."""
        return (self.signal.double() - self.offset).clamp(min=0) / self.gain

    def log_prob(self, value: Tensor) -> Tensor:
        return pixelwise(_log_density, value, *self.law)

    def cdf(self, value: Tensor) -> Tensor:
        return pixelwise(_below, value, *self.law)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        slopes = None if self.read_noise.ndim else _interval_and_slopes
        return pixelwise(_log_interval, low, high, *self.law, with_slopes=slopes)

    def icdf(self, value: Tensor) -> Tensor:
        middle, reach = self.signal.double(), 40 * self.gain * (torch.sqrt(self.rate + self.read_noise**2) + 1)
        return bisect_quantile(self.cdf, value, middle - reach, middle + reach)

    def likely_range(self, *, nats: float = 30.0) -> tuple[Tensor, Tensor]:
        """Bernstein's bounds for Poisson and normal noise (Boucheron, Lugosi & Massart 2013, section 2.4)."""
        signal, spread = self.signal.double(), self.gain * torch.sqrt(2 * nats * (self.rate + self.read_noise**2))
        return signal - spread, signal + spread + nats / 3 * self.gain

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        signal = self.signal
        rate = torch.nan_to_num(self.rate).to(signal.dtype).expand((*sample_shape, *self.batch_shape))
        normal = torch.randn(rate.shape, generator=generator, dtype=rate.dtype, device=rate.device)
        noise = draw_poisson(rate, generator).sub_(rate).add_(normal.mul_(self.read_noise)).mul_(self.gain)
        return noise.add_(signal)

    def nodes(self, *, numbers: int = 48, around: int = 65, limit: float = 7.0) -> tuple[Tensor, Tensor]:
        """Nodes of the read noise around numbers of electrons; of many, around one in a few, because these are alike."""
        rate, shape = self.rate, (-1, *(1,) * len(self.batch_shape))
        middle, reach = rate.detach(), limit * torch.sqrt(rate.detach())
        least = torch.floor(middle - reach).clamp(min=0)
        stride = torch.ceil((middle + reach + limit - least) / numbers)
        count = least + stride * torch.arange(numbers, dtype=rate.dtype, device=rate.device).view(shape)
        normal = normal_quadrature(torch.float64, limit=limit, count=around)
        place, share = (each.to(rate).view(shape) for each in normal)
        weight = torch.softmax(log_poisson(count, rate), 0)[:, None] * share
        nodes = self.signal.double() + self.gain * ((count - rate)[:, None] + self.read_noise * place)
        return nodes.flatten(0, 1), weight.flatten(0, 1)

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.gain**2 * (self.rate + self.read_noise**2)
