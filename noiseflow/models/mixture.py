"""Gaussian mixtures: parameters that are smooth functions of the signal, or a Gaussian to which rare outliers add."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile, of_finite
from noiseflow.distributions.numerics.monotone_maps import between_rows
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI, log_normal_interval, normal_cdf, normal_quadrature
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.flow import NUM_NODES, conditioning_features, conditioning_network, signal_nodes
from noiseflow.models.standardisation import Standardisation, between_nodes

# The penalty is log(1 + 5 r) nats, r the mean square of a second derivative along the signal coordinate: a parameter may change
# fast where the pixels say so. Its features are sharp; flows have no penalty. Of 30 noises after 50 000 pixels, the divergence of
# six that change fast falls by 0.001 to 0.012 nats per pixel; others change by a tenth on average.
_BENT = 5.0
_SHAPE_GAIN = 10  # shared parameters then learn as fast as the outputs of a network, which depend on many weights


class NormalMixture(NoiseModelBase):
    """Base class of mixtures of normal distributions."""

    @abstractmethod
    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-weights, means and log-scales at each signal, ``(*signal.shape, K)``; means and scales in detector units."""

    def forward(self, signal: Tensor) -> MixtureDistribution:
        return MixtureDistribution(signal, model=self)


class LearntMixture(NormalMixture):
    """Base class of mixtures with a ``bias``, and a network ``conditioner`` of what depends on the signal.

    Attributes:
        num_components: number of Gaussians.
        mean_preserving: shift the noise so that E[observation | signal] = signal, in closed form.
        width: hidden units of the network.
    """

    standardises_by_level = True
    fits_directly = True
    # models with many parameters overshoot at the rate that suits models with few
    joint_learning_rate = NoiseModelBase.learning_rate
    bias: nn.Parameter
    conditioner: nn.Sequential

    def __init__(self, num_components: int, *, mean_preserving: bool, width: int) -> None:
        super().__init__()
        check(num_components=num_components, width=width)
        self.num_components, self.mean_preserving, self.width = num_components, mean_preserving, width
        self.standardisation = Standardisation()

    def standardise(self, signal: Tensor, observation: Tensor, span: tuple[float, float] | None = None) -> None:
        """Measure and store the scaling of the data; see `Standardisation.set_from`."""
        self.standardisation.set_from(signal, observation, span)

    def _conditional(self, coordinate: Tensor) -> Tensor:
        """Outputs of the network at each coordinate of the signal, (*signal.shape, outputs)."""
        with torch.autocast(coordinate.device.type, enabled=False):
            at_nodes = self.conditioner(conditioning_features(signal_nodes(coordinate)).to(self.bias.dtype))
            return between_rows(at_nodes, *between_nodes(coordinate, self.bias.dtype, NUM_NODES))


class Mixture(LearntMixture):
    """Gaussians whose weights, means and log-scales depend smoothly on the signal (mixture density network, Bishop 1994).

    Args:
        num_components: number of Gaussians.
        shared_shape: use the same shape of the noise at all signals; only its location and scale vary.
        mean_preserving: shift the noise so that E[observation | signal] = signal, in closed form.
        width: hidden units of the network that computes the parameters from the signal.

    Raises:
        ValueError: `num_components` is less than one.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.Mixture()
        >>> noise(torch.tensor([0.2, 0.8])).log_prob(torch.tensor([0.25, 0.75])).shape
        torch.Size([2])
    """

    settings = ("num_components", "shared_shape", "mean_preserving", "width")

    def __init__(
        self, num_components: int = 3, *, shared_shape: bool = False, mean_preserving: bool = False, width: int = 32
    ) -> None:
        super().__init__(num_components, mean_preserving=mean_preserving, width=width)
        self.shared_shape = shared_shape
        # components differ initially, or they would remain equal: means ±½, the outer ones wider
        place = torch.linspace(-0.5, 0.5, num_components) if num_components > 1 else torch.zeros(1)
        start = torch.stack([-place.abs(), place, place.abs() - 0.2])
        self.bias = nn.Parameter(start / _SHAPE_GAIN if shared_shape else start)
        num_outputs = (1 if mean_preserving else 2) if shared_shape else 3 * num_components
        self.conditioner = conditioning_network(num_outputs, width, sharpness=1 if shared_shape else 4)

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        coordinate = self.standardisation.coordinate(signal)
        location, log_scale = self.standardisation(coordinate)
        conditional = self._conditional(coordinate)
        if self.shared_shape:
            raw = _SHAPE_GAIN * self.bias
            log_scale = log_scale + 5 * torch.tanh(conditional[..., 0] / 5)
            if not self.mean_preserving:
                location = location + torch.exp(log_scale) * conditional[..., 1]
        else:
            raw = self.bias + conditional.reshape(*coordinate.shape, 3, self.num_components)
        # log_softmax is three times as slow
        log_weight = raw[..., 0, :] - torch.logsumexp(raw[..., 0, :], -1, keepdim=True)
        centre, log_width = 20 * torch.tanh(raw[..., 1, :] / 20), 5 * torch.tanh(raw[..., 2, :] / 5)
        if self.mean_preserving:
            centre = centre - (log_weight.exp() * centre).sum(-1, keepdim=True)
            location = torch.zeros_like(location)
        means = (signal + location)[..., None] + torch.exp(log_scale)[..., None] * centre
        return log_weight.expand_as(means), means, log_width + log_scale[..., None]

    @property
    def roughness(self) -> Tensor | None:
        if self.shared_shape:  # the penalty costs 0.3 to 0.5 dB in reconstructions from few pixels
            return None
        nodes = signal_nodes(self.bias, coarse=True)
        second = self.conditioner(conditioning_features(nodes)).diff(n=2, dim=0) / (nodes[1] - nodes[0]) ** 2
        return torch.log1p(_BENT * second.square().mean(0)).sum()

    def extra_repr(self) -> str:
        shape = ", shared_shape=True" if self.shared_shape else ""
        return f"{self.num_components} components{shape}, width={self.width}, mean_preserving={self.mean_preserving}"


class GaussianWithOutliers(LearntMixture):
    """Gaussian noise whose width depends on the signal, to which rare outliers add: cosmic rays, X-rays, hot or dead pixels.

    Their frequency and size do not depend on the signal, unlike those of a `Mixture` with a shared shape, whose outliers grow
    with the noise. Contaminated normal distribution: Tukey 1960, "A survey of sampling from contaminated distributions".

    Args:
        num_components: number of Gaussians; all but the first describe the sizes of the outliers.
        mean_preserving: shift the noise so that E[observation | signal] = signal, in closed form.
        width: hidden units of the network that computes the width of the noise from the signal.

    Raises:
        ValueError: `num_components` is less than two.

    Example:
        >>> import noiseflow, torch
        >>> random = torch.Generator().manual_seed(0)
        >>> signal = 100 * torch.rand(5000, generator=random)
        >>> hit = torch.rand(5000, generator=random) < 0.02
        >>> observation = signal + torch.randn(5000, generator=random) + 60 * hit
        >>> noise = noiseflow.GaussianWithOutliers()
        >>> _ = noiseflow.fit(noise, signal, observation)
        >>> tail = 1 - noise(torch.tensor(50.0)).cdf(torch.tensor(80.0))
        >>> f"{tail:.2f}"
        '0.02'
    """

    settings = ("num_components", "mean_preserving", "width")

    def __init__(self, num_components: int = 4, *, mean_preserving: bool = False, width: int = 32) -> None:
        super().__init__(num_components, mean_preserving=mean_preserving, width=width)
        if num_components < 2:
            raise ValueError("num_components is 1, which leaves none for the outliers: use SignalDependentGaussian")
        # outliers of 2 % each, in units of the width of the noise: below, amid and above, 4.5 wide
        place = torch.linspace(-2, 2, num_components - 1) if num_components > 2 else torch.zeros(1)
        start = torch.stack([torch.full_like(place, -4), place, torch.full_like(place, 1.5)])
        self.bias = nn.Parameter(start / _SHAPE_GAIN)
        # of 50 000 pixels, sharp features halve the divergence of a Gaussian, and of one with outliers of 3 %
        self.conditioner = conditioning_network(1 if mean_preserving else 2, width, sharpness=4)

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        coordinate = self.standardisation.coordinate(signal)
        location, log_scale = self.standardisation(coordinate)
        conditional, log_unit = self._conditional(coordinate), self.standardisation.log_scale.mean()
        odds, place, log_width = _SHAPE_GAIN * self.bias
        log_weight = torch.log_softmax(nn.functional.pad(odds, (1, 0)), -1)
        place = nn.functional.pad(place, (1, 0)) * torch.exp(log_unit)
        added = nn.functional.pad(torch.exp(2 * (log_width + log_unit)), (1, 0))  # variance
        log_scale = log_scale + 5 * torch.tanh(conditional[..., 0] / 5)
        if self.mean_preserving:
            location = -(log_weight.exp() * place).sum(-1)
        else:
            location = location + torch.exp(log_scale) * conditional[..., 1]
        means = (signal + location)[..., None] + place
        return log_weight.expand_as(means), means, 0.5 * torch.log(torch.exp(2 * log_scale)[..., None] + added)

    def extra_repr(self) -> str:
        return f"{self.num_components} components, width={self.width}, mean_preserving={self.mean_preserving}"


class MixtureDistribution(NoiseDistribution):
    """A mixture of normal distributions; its components are computed on first use.

    Args:
        signal: clean signals, any shape.
    """

    per_pixel = ("signal",)

    def __init__(self, signal: Tensor, *, model: NormalMixture) -> None:
        super().__init__(signal.shape, like=signal)
        self.signal, self._model = self.clean(signal), model

    @property
    def source(self) -> tuple[nn.Module, Tensor] | None:
        """The model and the signal if the model allows tables, otherwise None."""
        return (self._model, self.signal) if self._model.tabulate else None

    @property
    def _components(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.once(lambda: self._model.components_at(self.signal))

    @property
    def log_weight(self) -> Tensor:
        """Log-weights of the components, (*signal.shape, K)."""
        return self._components[0]

    @property
    def means(self) -> Tensor:
        """Means of the components, (*signal.shape, K)."""
        return self._components[1]

    @property
    def log_scale(self) -> Tensor:
        """Logarithms of the standard deviations of the components, (*signal.shape, K)."""
        return self._components[2]

    def _standard(self, value: Tensor) -> Tensor:
        return (value[..., None] - self.means) * torch.exp(-self.log_scale)

    def log_prob(self, value: Tensor) -> Tensor:
        z = self._standard(value)
        return torch.logsumexp(self.log_weight - self.log_scale - 0.5 * z * z, -1) - LOG_SQRT_2PI

    def cdf(self, value: Tensor) -> Tensor:
        return (self.log_weight.exp() * normal_cdf(self._standard(value))).sum(-1).clamp(max=1)  # weights are rounded

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        ends = (of_finite(lambda each: self._standard(each[..., 0]), bound[..., None]) for bound in (low, high))
        return torch.logsumexp(self.log_weight + log_normal_interval(*ends), -1)

    def icdf(self, value: Tensor) -> Tensor:
        spread = 40 * self.log_scale.exp()
        low, high = (self.means - spread).amin(-1), (self.means + spread).amax(-1)
        return bisect_quantile(self.cdf, value, low + 0 * value, high + 0 * value)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        shape = (*sample_shape, *self.batch_shape)
        dtype, device = self.means.dtype, self.means.device
        uniform = torch.rand(shape, generator=generator, dtype=dtype, device=device)
        chosen = (uniform[..., None] > self.log_weight.exp().cumsum(-1))[..., :-1].sum(-1, keepdim=True)
        full = (*shape, self.means.shape[-1])
        means, log_scale = (each.expand(full).gather(-1, chosen)[..., 0] for each in (self.means, self.log_scale))
        return means + log_scale.exp() * torch.randn(shape, generator=generator, dtype=dtype, device=device)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        shape = (-1, *(1,) * self.means.ndim)
        found = normal_quadrature(torch.float64, count=101)
        nodes, weights = (each.to(self.means).view(shape) for each in found)
        places = self.means + torch.exp(self.log_scale) * nodes
        share = torch.exp(self.log_weight) * weights
        return places.movedim(-1, 1).flatten(0, 1), share.movedim(-1, 1).flatten(0, 1)

    @property
    def mean(self) -> Tensor:
        return (self.log_weight.exp() * self.means).sum(-1)

    @property
    def variance(self) -> Tensor:
        about = self.means - self.mean[..., None]
        return (self.log_weight.exp() * (torch.exp(2 * self.log_scale) + about**2)).sum(-1)
