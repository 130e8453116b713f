"""Noise that depends on more than the signal, such as the gain, the dwell time or the camera."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.arguments import real
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import Signal
from noiseflow.fitting.steps import FitResult
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.standardisation import LEAST_PIXELS, Standardisation
from noiseflow.models.wrapper import ModelAround, as_noise_model


class Conditioned(ModelAround):
    """Noise models at a grid of values of named conditions; between them, their parameters are interpolated linearly.

    ``fit(model, signal, observation, condition={"gain": …})`` makes one from any single-pixel model. Positive conditions that
    span more than a factor of four are interpolated in their logarithm.

    Args:
        model: the noise model at one condition.
        values: values of each condition in the grid, increasing, by name.

    Raises:
        ValueError: there is no condition, or its values do not increase.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(10.0, 100.0, 8000)
        >>> gain = torch.tensor([1.0, 2.0]).repeat(4000)
        >>> observation = signal + gain * torch.randn(8000, generator=torch.Generator().manual_seed(0))
        >>> noise = noiseflow.fit(noiseflow.Gaussian(), signal, observation, condition={"gain": gain}).noise_model
        >>> between = noise(torch.tensor(50.0), condition={"gain": 1.5})
        >>> bool(1.3 < between.stddev < 1.6)
        True
    """

    fits_directly = False

    def __init__(self, model: nn.Module, values: Mapping[str, Sequence[float]]) -> None:
        super().__init__(model)
        self.values = {name: tuple(map(float, each)) for name, each in values.items()}
        given = self.values.values()
        if not given or not all(each and list(each) == sorted(set(each)) and np.isfinite(each).all() for each in given):
            raise ValueError('give the values of at least one condition, increasing, such as {"gain": [1.0, 2.0, 4.0]}')
        sizes = [len(each) for each in self.values.values()]
        for name, tensor in self.model.state_dict().items():
            self.register_buffer(_stored(name), tensor.detach().expand(*sizes, *tensor.shape).clone())

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The smallest and the largest value of each condition."""
        return {name: (each[0], each[-1]) for name, each in self.values.items()}

    @torch.no_grad()
    def set(self, place: tuple[int, ...], model: NoiseModelBase) -> None:
        """Set the model, of the kind of the inner one, at one place of the grid, the index of the value of each condition."""
        for name, tensor in model.state_dict().items():
            getattr(self, _stored(name))[place] = tensor

    def of_each(
        self, change: Callable[[NoiseModelBase], NoiseModelBase], values: Mapping[str, Sequence[float]]
    ) -> Conditioned:
        """The changed models at some values of the conditions.

        Args:
            change: function from a noise model to another one.
            values: values of each condition in the new grid, by name.
        """
        found = Conditioned(change(self.model), values)
        for place in product(*(enumerate(each) for each in found.values.values())):
            condition = {name: value for name, (_, value) in zip(values, place, strict=True)}
            found.set(tuple(i for i, _ in place), change(self.at(condition)))
        return found

    @torch.no_grad()
    def at(self, condition: Mapping[str, float]) -> NoiseModelBase:
        """The noise model at one condition, to sample, evaluate or save like any other.

        Args:
            condition: a number for each name.

        Raises:
            ValueError: names differ, or a value is no single number, or lies outside the range of the fit.
        """
        names = set(condition) if isinstance(condition, Mapping) else ()
        if names != set(self.values) or any(np.ndim(each) for each in condition.values()):
            each = ", ".join(f'"{name}": …' for name in self.values)
            raise ValueError(
                f"the model needs a number for each condition: condition={{{each}}}, or model.at({{{each}}})"
            )
        corners = list(product(*(self._weights(name, float(condition[name])) for name in self.values)))
        found = copy.deepcopy(self.model)
        for name, tensor in found.state_dict().items():
            grid: Tensor = getattr(self, _stored(name))
            parts = (math.prod(w for _, w in corner) * grid[tuple(i for i, _ in corner)] for corner in corners)
            tensor.copy_(sum(parts, torch.zeros_like(tensor)))
        return found.requires_grad_(False)

    def _weights(
        self, name: str, value: float, *, rounded: float = 1e-6, ratio: float = 4.0
    ) -> list[tuple[int, float]]:
        """Neighbours in the grid of a value, and their weights: along the logarithm of positive values that span such a ratio."""
        values = self.values[name]
        slack = rounded * max(abs(values[0]), abs(values[-1]))
        if not values[0] - slack <= value <= values[-1] + slack:
            raise ValueError(f"{name}={value:g} is outside the range of the fit, {values[0]:g} … {values[-1]:g}")
        if len(values) == 1:
            return [(0, 1.0)]
        scale = math.log if values[0] > 0 and values[-1] > ratio * values[0] else float
        after = next((i for i, each in enumerate(values[:-1]) if value < each), len(values) - 1) or 1
        low, high = scale(values[after - 1]), scale(values[after])
        share = min(max((scale(min(max(value, values[0]), values[-1])) - low) / (high - low), 0.0), 1.0)
        return [(after - 1, 1 - share), (after, share)]

    def __call__(self, signal: Any, condition: Mapping[str, float] | None = None) -> Any:
        """The distribution of the observations at one condition, given signals of any shape; see `at`."""
        return self.at({} if condition is None else condition)(signal)

    def forward(self, signal: Signal) -> NoiseDistribution:
        """Refuses: the condition is missing; see `__call__`."""
        found: NoiseDistribution = self(signal)
        return found

    def config(self) -> dict[str, Any]:
        """The grid."""
        return {"values": {name: list(each) for name, each in self.values.items()}}

    def extra_repr(self) -> str:
        return ", ".join(f"{name} {low:g} … {high:g}" for name, (low, high) in self.ranges.items())


def _stored(name: str) -> str:
    return "at_" + name.replace(".", "_")


def flat_conditions(condition: Mapping[str, Any], observation: Tensor) -> dict[str, Tensor]:
    """The conditions of all pixels, (N,) each, float64, from numbers or arrays that broadcast with the observation, by name.
    Raises ValueError if there is none, or it does not broadcast, is not real or not finite."""
    found = {}
    for name, given in condition.items() if isinstance(condition, Mapping) else ():
        try:
            values = real(given, name).to(observation.device).double().expand(observation.shape).reshape(-1)
        except RuntimeError as error:
            shape = tuple(observation.shape)
            raise ValueError(f"condition {name} does not broadcast with the observation, {shape}") from error
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"condition {name} is NaN or infinite in some pixels; leave them out of all images")
        found[name] = values
    if not found:
        raise ValueError('condition has no names; give numbers or arrays by name, such as {"gain": 2.0}')
    return found


def grid_of(
    condition: Mapping[str, Tensor], *, most: int = 8
) -> tuple[dict[str, tuple[float, ...]], list[Tensor], Tensor]:
    """The grid of (N,) conditions: the values of each, or of more than `most` as many quantiles, by name; the index of the value
    of each pixel, (N,), of each condition; and (N,) numbers of its place in the grid. Raises ValueError if one has too few."""
    values = {}
    for name, each in condition.items():
        every = each.cpu().numpy()
        own = np.unique(every)
        if own.size > most:
            own = np.unique(np.quantile(every, (np.arange(most) + 0.5) / most))
        values[name] = tuple(own.tolist())
    places, number = [], torch.zeros((), dtype=torch.long)
    for each, listed in zip(condition.values(), values.values(), strict=True):
        grid = each.new_tensor(listed)
        places.append(torch.bucketize(each, (grid[1:] + grid[:-1]) / 2))
        number = number.to(each.device) * len(grid) + places[-1]
    fewest = int(torch.bincount(number, minlength=math.prod(map(len, values.values()))).min())
    if fewest < LEAST_PIXELS:
        raise ValueError(
            f"some combination of {', '.join(values)} has {fewest} pixels, fewer than {LEAST_PIXELS}; give more there"
        )
    return values, places, number


def fit_by_condition(
    fit: Callable[..., FitResult],
    noise_model: NoiseModelBase,
    signal: Tensor,
    observation: Tensor,
    condition: Mapping[str, Tensor],
    weights: Tensor | None,
    result: FitResult,
    options: Mapping[str, Any],
    *,
    pull: float = 10.0,
    most: int = 8,
    most_off: float = 0.03,
) -> FitResult:
    """Fit one model to the pixels around each place of a grid of conditions.

    The place with most pixels is fitted first, and the others start from its weights and are pulled to them, so that these can be
    interpolated: without it, 6700 pixels at four gains were up to 50 nats off between these, and with 1 to 100 up to 0.2. Pixels,
    values and weights are (N,), `options` further arguments of `fit`, and `result` is filled in and returned. Up to `most` values
    of a condition have a place each; more are gathered around as many quantiles. A warning says if models are off by more than
    `most_off` nats per pixel across a gap twice as wide as those of the grid: half of what a wrong offset costs at an unfitted
    gain where signals do not determine it.

    Raises:
        ValueError: a combination of values has too few pixels.
    """
    values, places, number = grid_of(condition, most=most)
    sizes = [len(each) for each in values.values()]
    counts = torch.bincount(number)
    fitted, nll = dict[int, Any](), 0.0
    for place in torch.argsort(counts, descending=True).tolist():
        chosen, start = number == place, copy.deepcopy(next(iter(fitted.values()), noise_model))
        if fitted:
            start.pull = pull
            for part in start.modules():
                if isinstance(part, Standardisation):
                    part.keeps_roots = True
        weight = None if weights is None else weights[chosen]
        one = fit(start, signal[chosen], observation[chosen], weights=weight, **options)
        fitted[place] = as_noise_model(one.noise_model)
        nll += one.held_out_nll * int(counts[place]) / int(counts.sum())
        result.num_steps, result.seconds = result.num_steps + one.num_steps, result.seconds + one.seconds
    found = Conditioned(next(iter(fitted.values())), values)
    for place, model in fitted.items():
        found.set(tuple(int(i) for i in np.unravel_index(place, sizes)), model)
    inner = [(name, place) for name, each in values.items() for place in range(1, len(each) - 1)]
    off = max((_between(found, *each, signal, observation, places) for each in inner), default=0.0)
    if off > most_off:
        warnings.warn(
            f"models at neighbouring conditions do not predict those between them (off by {off:.2g} nats per pixel), so that the "
            "noise between the fitted conditions is uncertain; give closer conditions, or pixels with low and high signals",
            stacklevel=5,
        )
    found.fitted_range = float(signal.min()), float(signal.max())
    result.noise_model, result.held_out_nll = found, nll
    return result


@torch.no_grad()
def _between(
    model: Conditioned,
    name: str,
    place: int,
    signal: Tensor,
    observation: Tensor,
    places: list[Tensor],
    most: int = 2**14,
) -> float:
    """Nats per pixel that the interpolation between the neighbours of one value loses to the fit at this value, at the middle
    place of the other conditions."""
    middle = {other: len(each) // 2 for other, each in model.values.items()} | {name: place}
    chosen = torch.stack([each == at for each, at in zip(places, middle.values(), strict=True)]).all(0)
    chosen = chosen.nonzero()[:most, 0]
    condition = {other: each[middle[other]] for other, each in model.values.items()}
    others = {name: tuple(each for each in model.values[name] if each != condition[name])}
    with_, without = model.at(condition), model.of_each(lambda each: each, model.values | others).at(condition)
    seen, known = observation[chosen], signal[chosen]
    return float(with_(known).log_prob(seen).mean() - without(known).log_prob(seen).mean())
