"""Physical noise models of detectors: shot noise plus read noise, exact at any dose."""

import math
from abc import abstractmethod

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.laws.poisson_gaussian import PoissonGaussianDistribution as PoissonGaussianDistribution
from noiseflow.models import detector_start
from noiseflow.models.base import Behind, NoiseModelBase

_LEAST_READ_NOISE = 1e-3


class ElectronCounter(NoiseModelBase):
    """A detector of electrons, whose first three parameters are gain, offset and read noise."""

    settles = True
    change: nn.Parameter

    @abstractmethod
    def _parameters_now(self) -> tuple[Tensor, ...]:
        """Gain, offset, read noise and any further parameters, float64 scalars."""

    def settle(self, signal: Tensor, observation: Tensor, behind: Behind | None = None) -> None:
        """Maximise the likelihood of (N,) signals and observations, starting from the current parameters.

        Args:
            signal, observation: detector units.
            behind: function that wraps the model in later stages of the detector, such as rounding and clipping.
        """
        detector_start.settle(self, self if behind is None else behind(self), signal, observation)

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
        """Read noise, electrons rms (before any multiplication)."""
        return self._parameters_now()[2]


class PoissonGaussian(ElectronCounter):
    """Shot noise plus read noise: observation = gain·(k + read_noise·n) + offset, k Poisson, n standard normal.

    The rate of k is (signal − offset)/gain. For signals below the offset it is 0, and read noise is centred on the signal: clean
    images have no such signals, but estimates may, and the likelihood then moves them back. The likelihood is exact at any dose,
    including single electrons. The variance, gain·(signal − offset) + (gain·read_noise)², determines only the gain and
    gain²·read_noise² − gain·offset. The offset is a free parameter, but is determined only by the shape of the noise: well if
    single electrons are resolved or the dose is low, poorly if the noise is nearly Gaussian.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.
        read_noise: electrons rms.

    Raises:
        ValueError: gain or read noise is not positive.

    Example:
        >>> import noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.5)
        >>> round(camera(torch.tensor(150.0)).variance.item(), 3)  # 2² · (25 electrons + 1.5²)
        109.0
    """

    starts_most_likely = True  # `standardise` finds nearly the maximum of the likelihood
    # the gain is measured on the residuals; training would hardly change a gain measured with a worse signal
    starts_anew = True
    most_joint_steps = 15  # the exact sum over electrons is slow, and the fit starts at the maximum of the likelihood
    origin: Tensor
    axes: Tensor

    def __init__(self, gain: float = 0.01, offset: float = 0.0, read_noise: float = 2.0) -> None:
        super().__init__()
        check(gain=gain, offset=offset, read_noise=read_noise)
        self.change = nn.Parameter(torch.zeros(3))
        start = torch.tensor([math.log(gain), offset, math.log(read_noise)], dtype=torch.float64)
        self.register_buffer("origin", start)
        self.register_buffer("axes", torch.diag(torch.tensor([1.0, gain * read_noise, 1.0], dtype=torch.float64)))

    def _parameters_now(self) -> tuple[Tensor, Tensor, Tensor]:
        now = self.origin.double() + self.axes.double() @ self.change.double()
        return torch.exp(now[0]), now[1], torch.exp(now[2].clamp(min=math.log(_LEAST_READ_NOISE)))

    def forward(self, signal: Tensor) -> PoissonGaussianDistribution:
        return PoissonGaussianDistribution(signal, *self._parameters_now())

    def at_read_noise(self, signal: Tensor, read_noise: Tensor) -> PoissonGaussianDistribution:
        gain, offset, _ = self._parameters_now()
        electrons = (read_noise.double() / gain).clamp(min=_LEAST_READ_NOISE).expand(signal.shape)
        return PoissonGaussianDistribution(signal, gain, offset, electrons)

    def standardise(self, signal: Tensor, observation: Tensor, *, settle: bool = True) -> None:
        """Set the parameters to the maximum of the likelihood of (N,) signals and observations, from many starting points.

        If single electrons are resolved, each alignment of their peaks with the pixel values is a maximum. The parameters are
        scaled by the curvature of the likelihood, so that one learning rate suits both gains and poorly determined offsets. A
        converter around the model passes ``settle=False`` and calls `settle` itself.
        """
        found, axes = detector_start.find_detector(signal, observation)
        with torch.no_grad():
            self.change.zero_()
            self.origin.copy_(torch.tensor([math.log(found.gain), found.offset, math.log(found.read_noise)]))
            self.axes.copy_(axes)
        if settle:
            self.settle(signal, observation)

    def extra_repr(self) -> str:
        gain, offset, read_noise = (float(each.detach()) for each in self._parameters_now())
        return f"gain={gain:.5g}, offset={offset:.5g}, read_noise={read_noise:.4g}"
