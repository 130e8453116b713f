"""Noise models from the physics of a detector: shot noise plus read noise, exact at any dose."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from noiseflow.distributions.base import NoiseDistribution, bisect_quantile
from noiseflow.distributions.electrons import log_both_tails, log_density, log_interval
from noiseflow.models.base import NoiseModelBase

_LEAST_READ_NOISE = 1e-3


class PoissonGaussian(NoiseModelBase):
    """Shot noise plus read noise: observation = gain·(k + read_noise·n) + offset, k Poisson, n standard normal.

    The rate of k is (signal − offset)/gain. Below the offset it is 0, and read noise is spread about the signal: no clean image
    lies there, but an estimate may, and the readings pull it back. The likelihood is exact at any dose, single electrons
    included. The second moments, variance = gain·(signal − offset) + (gain·read_noise)², identify only the gain and
    gain²·read_noise² − gain·offset; the offset itself is known only as far as the shape of the noise tells it: well where
    single electrons are resolved or the dose is low, hardly where noise is Gaussian. It is a parameter all the same.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.
        read_noise: electrons rms.

    Raises:
        ValueError: gain or read noise not positive.
    """

    starts_most_likely = True  # `standardise` leaves little to climb
    most_joint_steps = 15  # the exact sum over electrons takes long, and it starts at its most likely parameters
    origin: Tensor
    axes: Tensor

    def __init__(self, gain: float = 0.01, offset: float = 0.0, read_noise: float = 2.0) -> None:
        super().__init__()
        if not (gain > 0 and read_noise > 0):
            raise ValueError(f"gain is {gain} and read_noise is {read_noise}; both must be positive")
        self.change = nn.Parameter(torch.zeros(3))
        start = torch.tensor([math.log(gain), offset, math.log(read_noise)], dtype=torch.float64)
        self.register_buffer("origin", start)
        self.register_buffer("axes", torch.diag(torch.tensor([1.0, gain * read_noise, 1.0], dtype=torch.float64)))

    def _parameters_now(self) -> tuple[Tensor, Tensor, Tensor]:
        now = self.origin.double() + self.axes.double() @ self.change.double()
        return torch.exp(now[0]), now[1], torch.exp(now[2].clamp(min=math.log(_LEAST_READ_NOISE)))

    @property
    def gain(self) -> Tensor:
        """Counts per electron."""
        return self._parameters_now()[0]

    @property
    def offset(self) -> Tensor:
        """Counts at zero dose."""
        return self._parameters_now()[1]

    @property
    def read_noise(self) -> Tensor:
        """Electrons rms."""
        return self._parameters_now()[2]

    def forward(self, signal: Tensor) -> PoissonGaussianDistribution:
        """The distribution of observations of pixels with the given signals, any shape, detector units."""
        return PoissonGaussianDistribution(signal, *self._parameters_now())

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the most likely of many detectors with the variances of the (N,) signals and observations.

        Where single electrons are resolved the likelihood has many maxima, one for each way to lay the comb of electrons on the
        readings; the starts cover them. The parameters are then scaled by the curvature of the likelihood, so that one learning
        rate suits a comb of fifty electrons, known to a part in a thousand, and an offset that is hardly known at all.
        """
        from noiseflow.models.detector_start import find_detector, likelihood_axes

        found = find_detector(signal, observation)
        axes = likelihood_axes(found, signal, observation)
        with torch.no_grad():
            self.change.zero_()
            self.origin.copy_(torch.tensor([math.log(found.gain), found.offset, math.log(found.read_noise)]))
            self.axes.copy_(axes)
        self.settle(signal, observation)

    def settle(
        self, signal: Tensor, observation: Tensor, behind: Callable[[NoiseModelBase], NoiseModelBase] | None = None
    ) -> None:
        """Climb to the maximum of the likelihood of (N,) signals and observations, from where the parameters are.

        Args:
            signal, observation: detector units.
            behind: puts the detector behind what stands in front of its values, such as rounding and clipping.
        """
        from noiseflow.models.detector_start import settle

        settle(self, self if behind is None else behind(self), signal, observation)

    def extra_repr(self) -> str:
        gain, offset, read_noise = (float(each.detach()) for each in self._parameters_now())
        return f"gain={gain:.5g}, offset={offset:.5g}, read_noise={read_noise:.4g}"


class PoissonGaussianDistribution(NoiseDistribution):
    """Distribution of gain·(k + read_noise·n) + offset.

    Args:
        signal: clean readings, detector units.
        gain, offset, read_noise: scalars, float64.
    """

    def __init__(self, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.gain, self.offset, self.read_noise = signal, gain, offset, read_noise
        self.rate = (signal.double() - offset).clamp(min=0) / gain

    def electrons(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals and rates of observations, electrons, float64."""
        residual = (value.double() - self.signal.double()) / self.gain
        return residual, self.rate.expand_as(residual)

    def log_prob(self, value: Tensor) -> Tensor:
        residual, rate = self.electrons(value)
        return self._as(value, log_density(residual, rate, self.read_noise) - torch.log(self.gain))

    def log_both_tails(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """``(log F, log(1 − F))`` in float64, each accurate in its own tail."""
        return log_both_tails(*self.electrons(value), self.read_noise)

    def cdf(self, value: Tensor) -> Tensor:
        return self._as(value, self.log_both_tails(value)[0].exp())

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        bottom, top = self._bounds(low, high)
        return self._as(low, log_interval(bottom, top, self.rate.expand_as(bottom), self.read_noise))

    def _bounds(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals of bounds, electrons; an infinite one moves to where nothing is left beyond it, without a gradient."""
        finite = [torch.isfinite(value) for value in (low, high)]
        (bottom, rate), (top, _) = (
            self.electrons(torch.where(known, value, torch.zeros_like(value)))
            for known, value in zip(finite, (low, high), strict=True)
        )
        end = (40 * torch.sqrt(rate + self.read_noise**2) + 100).detach()
        least = torch.where(finite[1], torch.minimum(top.detach() - end, -end), -end)
        most = torch.where(finite[0], torch.maximum(bottom.detach() + end, end), end)
        return torch.where(finite[0], bottom, torch.where(low > 0, most, least)), torch.where(
            finite[1], top, torch.where(high > 0, most, least)
        )

    def icdf(self, value: Tensor) -> Tensor:
        reach = 40 * self.variance.sqrt().double() + 40 * self.gain
        middle = self.mean.double() + 0 * value
        return self._as(value, bisect_quantile(self, value.double(), middle - reach, middle + reach))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            rate = self._as(self.signal, self.rate).expand((*sample_shape, *self.batch_shape))
            normal = torch.randn(rate.shape, generator=generator, dtype=rate.dtype, device=rate.device)
            gain, read_noise = (self._as(self.signal, each) for each in (self.gain, self.read_noise))
            noise = torch.poisson(rate, generator=generator).sub_(rate).add_(normal.mul_(read_noise)).mul_(gain)
            return noise.add_(self.signal)

    def _as(self, like: Tensor, result: Tensor) -> Tensor:
        return result.to(torch.promote_types(like.dtype, self.signal.dtype))

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self._as(self.signal, self.gain**2 * (self.rate + self.read_noise**2))
