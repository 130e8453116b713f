"""Conditional normalizing flows in one dimension: p(observation | signal) as a sequence of monotone maps to a standard normal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.laws.base import LatentDistribution, resolved_nodes
from noiseflow.distributions.numerics.monotone_maps import (
    AFFINE,
    SCALE,
    TAIL,
    Layer,
    Transform,
    back_through,
    bounded,
    radial_layer,
    spline_layer,
    through,
)
from noiseflow.distributions.pixels import Signal, require_image, values_of, windows_of
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.standardisation import Standardisation, between_nodes, interpolate_cubic

NUM_NODES = 257
WIDTH = 32  # hidden units of a conditioning network


def conditioning_network(num_outputs: int, width: int, num_inputs: int = 2, *, sharpness: float = 1) -> nn.Sequential:
    """A small network of signal features. Its outputs are initially zero; its weights have fixed initial values, those of the
    first layer in proportion to `sharpness`: sharp features can change within a small part of the range of signals."""
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]):  # torch initialises layers from the global random state
        first, hidden, last = nn.Linear(num_inputs, width), nn.Linear(width, width), nn.Linear(width, num_outputs)
    with torch.no_grad():
        for layer, share in ((first, sharpness), (hidden, 1)):
            for each in (layer.weight, layer.bias):
                nn.init.uniform_(each, -share * layer.in_features**-0.5, share * layer.in_features**-0.5, generator)
        last.weight.zero_()
        last.bias.zero_()
    return nn.Sequential(first, nn.Tanh(), hidden, nn.Tanh(), last)


def conditioning_features(coordinate: Tensor) -> Tensor:
    """(..., 2) features of signal coordinates in [0, 1]."""
    return torch.stack([2 * coordinate - 1, 2 * coordinate * coordinate - 1], -1)


def signal_nodes(like: Tensor, *, coarse: bool = False) -> Tensor:
    """The (257,) signal coordinates at which networks are evaluated; outputs are interpolated linearly in between; every
    eighth of them if `coarse`, for what each step computes."""
    return torch.linspace(0, 1, NUM_NODES, dtype=like.dtype, device=like.device)[:: 8 if coarse else 1]


class ConditionalFlow(NoiseModelBase):
    """A noise model built from layers that map an observation to a standard normal latent.

    Args:
        layers: the maps, in order from the observation to the latent.
        mean_preserving: shift the noise so that E[observation | signal] = signal (before any digitisation). A joint fit
            requires it; otherwise an offset of the signal cannot be distinguished from a mean of the noise.
        width: hidden units of the network that computes the parameters of the conditional layers from the signal.
        neighbourhood: side (odd) of the window of clean signals around each pixel that affects location and scale of its
            noise. Off (1) by default, because such a model can learn the structure of the scene instead of the noise. If it
            is larger, signals must be images (..., y, x).

    Attributes:
        tabulate: look likelihoods and samples of large inputs up in tables (mean interpolation error below 1e-3 nats and
            1e-3 standard deviations); set it to False for exact values.
    """

    standardises_by_level = True
    settings: tuple[str, ...] = ("mean_preserving", "width")
    neighbourhood: int = 1

    def __init__(
        self, layers: Sequence[Layer], *, mean_preserving: bool = False, width: int, neighbourhood: int = 1
    ) -> None:
        super().__init__()
        check(neighbourhood=neighbourhood, width=width)
        self.layers, self.neighbourhood = tuple(layers), neighbourhood
        self.mean_preserving = mean_preserving
        self.width = width
        self.standardisation = Standardisation()
        self.bias = nn.Parameter(torch.tensor([value for layer in self.layers for value in layer.initial]))
        num_outputs = sum(len(layer.initial) for layer in self.layers if layer.conditional)
        self.conditioner = conditioning_network(num_outputs, width)
        if neighbourhood > 1:
            self.surroundings = conditioning_network(2, width, num_inputs=neighbourhood**2 - 1)

    @property
    def fits_directly(self) -> bool:
        return not self.needs_image

    @property
    def needs_image(self) -> bool:
        """Whether the model uses a neighbourhood and needs images."""
        return self.neighbourhood > 1

    def forward(self, signal: Signal) -> FlowDistribution:
        """The distribution of the observations, given signals of any shape, detector units.

        Raises:
            ValueError: the signal is flat, but the model uses a neighbourhood.
        """
        if not self.needs_image:
            return FlowDistribution(self, values_of(signal))
        require_image(signal, f"this model uses {self.neighbourhood} x {self.neighbourhood} pixels around each pixel")
        return FlowDistribution(self, values_of(signal), windows_of(signal, self.neighbourhood))

    def standardise(self, signal: Signal, observation: Tensor, span: tuple[float, float] | None = None) -> None:
        """Measure and store the scaling of the data; see `Standardisation.set_from`."""
        self.standardisation.set_from(values_of(signal), observation, span)

    def parameters_at(self, signal: Tensor, windows: Tensor | None = None) -> tuple[Tensor, Tensor, list[Transform]]:
        """Location and log-scale of the noise, detector units, and the maps, at each signal with its window (..., k²)."""
        with torch.autocast(signal.device.type, enabled=False):
            coordinate = self.standardisation.coordinate(signal)
            location, log_scale = self.standardisation(coordinate)
            if windows is not None:
                contrast = self.standardisation.coordinate(windows) - coordinate[..., None]
                middle = self.neighbourhood**2 // 2
                others = torch.cat([contrast[..., :middle], contrast[..., middle + 1 :]], -1)
                raw = self.surroundings(4 * others.to(self.bias.dtype))
                log_scale = log_scale + bounded(raw[..., 1], 5)
                location = location + torch.exp(log_scale) * bounded(raw[..., 0], 10)  # standard deviations
            if self.layers == (SCALE,):  # leaves the mean at 0
                location = torch.zeros_like(location)
            elif self.mean_preserving:
                location = -torch.exp(log_scale) * interpolate_cubic(self._mean_of_standardised(), coordinate)
            return signal + location, log_scale, self.transforms(coordinate)

    def transforms(self, coordinate: Tensor) -> list[Transform]:
        """The maps at each signal coordinate: exact at 257 nodes, with parameters interpolated linearly in between. The network
        is therefore evaluated only at the nodes, whatever the number of pixels."""
        row, weight = between_nodes(coordinate, self.bias.dtype, NUM_NODES)
        maps = zip(self.layers, self.transforms_of_network(signal_nodes(coordinate)), strict=True)
        return [each.between_rows(row, weight) if layer.conditional else each for layer, each in maps]

    def transforms_of_network(self, coordinate: Tensor) -> list[Transform]:
        """The maps from the network at each signal coordinate, without interpolation."""
        conditional = self.conditioner(conditioning_features(coordinate).to(self.bias.dtype))
        more = iter(torch.split(conditional, [len(each.initial) for each in self.layers if each.conditional], -1))
        parts = zip(self.layers, torch.split(self.bias, [len(each.initial) for each in self.layers]), strict=True)
        return [layer.build(raw + next(more) if layer.conditional else raw) for layer, raw in parts]

    def _mean_of_standardised(self) -> Tensor:
        """Mean of the standardised residual at a grid of signal coordinates, by quadrature."""
        coordinate = signal_nodes(self.bias, coarse=torch.is_grad_enabled())
        maps = self.transforms(coordinate)
        nodes, weights = resolved_nodes(
            lambda value: through(maps, value)[0], lambda latent: back_through(maps, latent), coordinate
        )
        return (weights * nodes).sum(0)

    def extra_repr(self) -> str:
        low, high = float(self.standardisation.signal_low), float(self.standardisation.signal_high)
        return (
            f"signals {low:g} … {high:g}, {len(self.layers)} layers, width={self.width}, "
            f"mean_preserving={self.mean_preserving}"
        )

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model."""
        return super().config() | ({"neighbourhood": self.neighbourhood} if self.needs_image else {})


class FlowDistribution(LatentDistribution):
    """The distribution that a `ConditionalFlow` returns; its parameters are computed on first use."""

    per_pixel = ("_signal", "_windows")

    def __init__(self, flow: ConditionalFlow, signal: Tensor, windows: Tensor | None = None) -> None:
        super().__init__(signal.shape, like=signal)
        self._flow, self._signal, self._windows = flow, self.clean(signal), windows

    @property
    def source(self) -> tuple[nn.Module, Tensor] | None:
        """The flow and the signal; None if the model uses a neighbourhood."""
        return (self._flow, self._signal) if self._windows is None else None

    @property
    def _parameters(self) -> tuple[Tensor, Tensor, list[Transform]]:
        return self.once(lambda: self._flow.parameters_at(self._signal, self._windows))

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        location, log_scale, transforms = self._parameters
        latent, ladj = through(transforms, (value - location) * torch.exp(-log_scale))
        return latent, ladj - log_scale

    def from_latent(self, latent: Tensor) -> Tensor:
        location, log_scale, transforms = self._parameters
        return location + torch.exp(log_scale) * back_through(transforms, latent)


class RadialFlow(ConditionalFlow):
    """The noise model of Kniesel et al. (CVPR 2022, doi:10.1109/CVPR52688.2022.02018), with a normalised density.

    It has a conditional affine layer followed by radial layers, of which those closest to the data depend on the signal.

    Args:
        num_layers: number of radial layers.
        num_conditional: number of radial layers that depend on the signal, half of them by default. With 0, the shape of the
            noise is the same at all signals and only its location and scale vary.
        mean_preserving: see `ConditionalFlow`.
        width: hidden units of the conditioning network.
        neighbourhood: see `ConditionalFlow`.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.RadialFlow()
        >>> noise(torch.tensor([0.2, 0.8])).log_prob(torch.tensor([0.25, 0.75])).shape
        torch.Size([2])
    """

    settings = (*ConditionalFlow.settings, "num_layers", "num_conditional")

    def __init__(
        self,
        num_layers: int = 8,
        *,
        num_conditional: int | None = None,
        mean_preserving: bool = False,
        width: int = WIDTH,
        neighbourhood: int = 1,
    ) -> None:
        check(num_layers=num_layers, num_conditional=num_conditional)
        conditional = num_layers - num_layers // 2 if num_conditional is None else num_conditional
        centres = [((-1) ** i) * 0.5 * ((i + 1) // 2) for i in range(num_layers)]
        parts = (True, centres[:conditional]), (False, centres[conditional:])
        layers = [AFFINE, *(radial_layer(*some, conditional=each) for each, some in parts if some)]
        super().__init__(layers, mean_preserving=mean_preserving, width=width, neighbourhood=neighbourhood)
        self.num_layers, self.num_conditional = num_layers, conditional


class SplineFlow(ConditionalFlow):
    """The default noise model: conditional affine layer, conditional monotone spline, learnt tail weights.

    Args:
        num_bins: number of bins of the spline.
        mean_preserving: see `ConditionalFlow`.
        width: hidden units of the conditioning network.
        neighbourhood: see `ConditionalFlow`.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.SplineFlow(mean_preserving=True)
        >>> torch.allclose(noise(torch.tensor([0.2, 0.8])).mean, torch.tensor([0.2, 0.8]), atol=1e-3)
        True
    """

    settings = (*ConditionalFlow.settings, "num_bins")
    # models with many parameters overshoot at the rate that suits models with few
    joint_learning_rate = NoiseModelBase.learning_rate

    def __init__(
        self, num_bins: int = 16, *, mean_preserving: bool = False, width: int = WIDTH, neighbourhood: int = 1
    ) -> None:
        check(num_bins=num_bins)
        layers = [AFFINE, spline_layer(num_bins), TAIL]
        super().__init__(layers, mean_preserving=mean_preserving, width=width, neighbourhood=neighbourhood)
        self.num_bins = num_bins


class SignalDependentGaussian(ConditionalFlow):
    """Gaussian noise whose standard deviation is a smooth function of the signal.

    Args:
        width: hidden units of the network for the standard deviation.
        neighbourhood: see `ConditionalFlow`.
        straight: the variance is a straight line of the signal, as of shot noise with read noise.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(0.2, 1.0, 5000)
        >>> observation = signal + 0.1 * signal * torch.randn(5000, generator=torch.Generator().manual_seed(0))
        >>> noise = noiseflow.SignalDependentGaussian()
        >>> _ = noiseflow.fit(noise, signal, observation, num_steps=100, generator=torch.Generator().manual_seed(1))
        >>> narrow, wide = noise(torch.tensor([0.3, 0.9])).variance.sqrt()
        >>> bool(2 < wide / narrow < 4)
        True
    """

    settings = ("width",)
    starts_anew = True  # the width is measured on the residuals; training hardly changes a width from a worse signal

    def __init__(self, *, width: int = WIDTH, neighbourhood: int = 1, straight: bool = False) -> None:
        super().__init__([SCALE], mean_preserving=True, width=width, neighbourhood=neighbourhood)
        self.standardisation.straight = straight
        self.conditioner.requires_grad_(not straight)

    def config(self) -> dict[str, Any]:
        return super().config() | ({"straight": True} if self.standardisation.straight else {})
