"""Noise models from the physics of a detector: shot noise plus read noise, exact at any dose."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from noiseflow.distributions.poisson_gaussian import PoissonGaussianDistribution as PoissonGaussianDistribution
from noiseflow.distributions.poisson_gaussian import UnevenPoissonGaussian
from noiseflow.models.base import NoiseModelBase

_LEAST_READ_NOISE = 1e-3


class ElectronCounter(NoiseModelBase):
    """A detector of electrons, whose first three parameters are gain, offset and read noise."""

    @abstractmethod
    def _parameters_now(self) -> tuple[Tensor, ...]:
        """Gain, offset, read noise and what else there is, float64 numbers."""

    @property
    def gain(self) -> Tensor:
        """Mean counts per electron."""
        return self._parameters_now()[0]

    @property
    def offset(self) -> Tensor:
        """Counts without electrons."""
        return self._parameters_now()[1]

    @property
    def read_noise(self) -> Tensor:
        """Electrons rms; before multiplication, where there is any."""
        return self._parameters_now()[2]


class PoissonGaussian(ElectronCounter):
    """Shot noise plus read noise: observation = gain·(k + read_noise·n) + offset, k Poisson, n standard normal.

    The rate of k is (signal − offset)/gain. Below the offset it is 0, and read noise is spread about the signal: no clean image
    lies there, but an estimate may, and the pixel values pull it back. The likelihood is exact at any dose, single electrons
    included. The second moments, variance = gain·(signal − offset) + (gain·read_noise)², identify only the gain and
    gain²·read_noise² − gain·offset; the offset itself is known only as far as the shape of the noise tells it: well where
    single electrons are resolved or the dose is low, hardly where noise is Gaussian. It is a parameter all the same.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.
        read_noise: electrons rms.

    Raises:
        ValueError: gain or read noise not positive.

    Example:
        >>> import noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.5)
        >>> round(camera(torch.tensor(150.0)).variance.item(), 3)  # 2² · (25 electrons + 1.5²)
        109.0
    """

    starts_most_likely = True  # `standardise` leaves little to climb
    starts_anew = True  # its gain is that of the residuals; from the gain about a worse signal it would hardly move
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

    def forward(self, signal: Tensor) -> PoissonGaussianDistribution:
        """The distribution of observations of pixels with the given signals, any shape, detector units."""
        return PoissonGaussianDistribution(signal, *self._parameters_now())

    def at_read_noise(self, signal: Tensor, read_noise: Tensor) -> UnevenPoissonGaussian:
        gain, offset, _ = self._parameters_now()
        electrons = (read_noise.double() / gain).clamp(min=_LEAST_READ_NOISE).expand(signal.shape)
        return UnevenPoissonGaussian(signal, gain, offset, electrons)

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the most likely of many detectors with the variances of the (N,) signals and observations.

        Where single electrons are resolved the likelihood has many maxima, one for each way to lay the comb of electrons on the
        pixel values; the starts cover them. The parameters are then scaled by the curvature of the likelihood, so that one
        learning rate suits a comb of fifty electrons, known to a part in a thousand, and an offset that is hardly known at all.
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
