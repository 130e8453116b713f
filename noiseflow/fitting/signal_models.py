"""Models of the clean signal: their interface, a known image, a static scene observed repeatedly, and the weight of a penalty,
chosen by the likelihood of held-out pixels."""

import copy
import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, wraps
from typing import Any, ParamSpec, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arrays import floating
from noiseflow.fitting.steps import FitResult, WeightChoice
from noiseflow.models.base import Described

PART = 2**20  # pixels predicted, or sampled, at once
_RATE = 0.15  # of the standard deviation of the exposures: a hundred steps with decreasing rates reach the estimate of any pixel
_Given = ParamSpec("_Given")
# Users state the scale of their penalty by guess: the first ladder reaches a thousandth and a thousand times of it. Wide rungs
# step over the lower minimum of noise that is too wide under a weight that is too low: 7 dB of one image denoised
_WIDE, _MOST = 16.0, 5
HELD_OUT = "held-out"


@runtime_checkable
class SignalModel(Protocol):
    """Interface of a signal model: any differentiable ``nn.Module`` that predicts the signal of given pixels.

    Two methods are optional. ``signal()`` returns all pixels as a flat tensor, if that is cheaper than prediction by index.
    ``penalty()`` returns a scalar that is added to the mean negative log-likelihood (a weighted regulariser). A model whose steps
    depend on more than its parameters returns that in a dictionary, ``between_steps()``, and resumes by ``go_on_from(kept)``.

    Example:
        >>> import noiseflow, torch
        >>> class Plane(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.slope = torch.nn.Parameter(torch.ones(2))
        ...     def forward(self, pixels):
        ...         return self.slope[0] * (pixels // 32) / 32 + self.slope[1] * (pixels % 32) / 32
        >>> plane = Plane()
        >>> rows = torch.arange(32.0)[:, None] / 32
        >>> observation = 1.5 * rows + 0.5 * rows.T + 0.1 * torch.randn(32, 32, generator=torch.Generator().manual_seed(0))
        >>> result = noiseflow.fit(noiseflow.Gaussian(), plane, observation, num_steps=200)
        >>> [round(slope, 1) for slope in plane.slope.tolist()]
        [1.5, 0.5]
    """

    def __call__(self, pixels: Tensor) -> Tensor:
        """Predict signals.

        Args:
            pixels: (B,) flat pixel indices into the observation.

        Returns:
            (B,) signals, differentiable with respect to the model's parameters.
        """
        ...


class KnownSignal(Described):
    """A fixed image as a signal model without parameters, such as the estimate of a reconstruction.

    Args:
        signal: clean image, any shape, detector units.

    Example:
        >>> import noiseflow, torch
        >>> noiseflow.KnownSignal(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))(torch.tensor([2]))
        tensor([3.])
    """

    flat: Tensor

    def __init__(self, signal: Tensor | NDArray[Any]) -> None:
        super().__init__()
        self.register_buffer("flat", floating(signal).detach().reshape(-1), persistent=False)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.flat[pixels]

    def extra_repr(self) -> str:
        return f"{self.flat.numel()} pixels"

    def signal(self) -> Tensor:
        """All pixels, flat."""
        return self.flat


class StaticScene(Described):
    """Repeated exposures of a static scene: the clean image is estimated, with one parameter per pixel.

    For Gaussian noise the maximum-likelihood image is the mean of the exposures. For noise with outliers, long tails or clipping,
    a joint fit gives a more accurate image, because it weights every exposure according to the fitted noise.

    Every exposure contributes to the image it is compared with, so residuals are too small by √(1 − 1/n) (Neyman & Scott 1948,
    doi:10.2307/1914288). The prediction for each pixel of an exposure is therefore moved away from that exposure by the inverse
    factor. The fitted noise then has the correct width for any distribution, and the correct skewness to about 1/n.

    The signals must span many widths of the noise, unless the noise model does not depend on the signal. Otherwise the free pixel
    values can encode the residuals of their exposures for the noise model.

    Args:
        exposures: (n, ...) repeated exposures, detector units; the clean image is initialised with their mean. NaN and infinite
            pixels are excluded.

    Raises:
        ValueError: fewer than two exposures.

    Example:
        >>> import noiseflow, torch
        >>> exposures = 5 + torch.randn(8, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> noiseflow.StaticScene(exposures).image().shape
        torch.Size([32, 32])
    """

    exposures: Tensor
    widening: Tensor

    def __init__(self, exposures: Tensor | NDArray[Any]) -> None:
        super().__init__()
        if exposures.shape[0] < 2:
            raise ValueError("a static scene needs at least two exposures, to separate signal from noise")
        frames = floating(exposures).detach()
        self.count, self.shape = frames.shape[0], frames.shape[1:]
        flat = frames.reshape(self.count, -1)
        seen = torch.isfinite(flat)
        flat = torch.where(seen, flat, torch.zeros_like(flat))
        number = seen.sum(0).clamp(min=1).to(flat.dtype)
        mean = flat.sum(0) / number
        self.scene = nn.Parameter(torch.where(seen.any(0), mean, mean.mean()))
        # not part of the state, because every copy of the state would hold all exposures
        self.register_buffer("exposures", torch.where(seen, flat, mean).reshape(-1), persistent=False)
        widening = torch.where(number > 1, torch.sqrt(number / (number - 1).clamp(min=1)), torch.ones_like(number))
        self.register_buffer("widening", widening, persistent=False)
        self._deviation = float((self.exposures - mean.repeat(self.count)).abs().median()) / 0.6745

    def forward(self, pixels: Tensor) -> Tensor:
        place = pixels % self.scene.numel()
        return self._apart(self.scene[place], self.exposures[pixels], self.widening[place])

    def signal(self) -> Tensor:
        """Predictions for all pixels of all exposures, flat."""
        return self._apart(self.scene.repeat(self.count), self.exposures, self.widening.repeat(self.count))

    @staticmethod
    def _apart(scene: Tensor, exposure: Tensor, widening: Tensor) -> Tensor:
        return exposure + (scene - exposure) * widening

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The scene, with a learning rate proportional to the standard deviation of the exposures."""
        spread = self._deviation or float(self.scene.detach().std()) or 1.0
        return [{"params": [self.scene], "lr": _RATE * spread}]

    def extra_repr(self) -> str:
        return f"{self.count} exposures of {' x '.join(map(str, self.shape))} pixels"

    def image(self) -> Tensor:
        """The clean image."""
        return self.scene.detach().reshape(self.shape)


@torch.no_grad()
def predicted(signal_model: nn.Module, observation: Tensor) -> Tensor:
    """The signal of all pixels, shaped like the observation."""
    if hasattr(signal_model, "signal"):
        whole: Tensor = signal_model.signal()  # type: ignore[operator]
    else:
        pixels = torch.arange(observation.numel(), device=observation.device)
        whole = torch.cat([signal_model(part) for part in torch.split(pixels, PART)])
    return whole.detach().reshape(observation.shape)


@torch.no_grad()
def check_signal_model(signal_model: nn.Module, num_pixels: int) -> None:
    """Check that a signal model returns what `SignalModel` specifies. Raises ValueError if `signal()` is not flat, `penalty()` is
    not a scalar, the prediction for two pixels is not two numbers, or some are not in single or double precision."""
    kind = type(signal_model).__name__
    device = next((p.device for p in signal_model.parameters()), torch.device("cpu"))
    if hasattr(signal_model, "signal"):
        shape = _shape(signal_model.signal(), f"{kind}.signal()")  # type: ignore[operator]
        if shape != (num_pixels,):
            raise ValueError(f"{kind}.signal() has shape {shape}; return all {num_pixels} pixels, with .reshape(-1)")
    some = torch.arange(min(2, num_pixels), device=device)
    shape = _shape(signal_model(some), f"{kind}(pixels)")
    if shape != tuple(some.shape):
        raise ValueError(f"{kind} predicts shape {shape} for {some.numel()} pixel indices; return one signal for each")
    if hasattr(signal_model, "penalty"):
        penalty = signal_model.penalty()  # type: ignore[operator]
        if not isinstance(penalty, float | int) and (shape := _shape(penalty, f"{kind}.penalty()")):
            raise ValueError(f"{kind}.penalty() has shape {shape}; return a scalar, such as .mean()")


def _shape(found: Any, what: str) -> tuple[int, ...]:
    if not isinstance(found, Tensor) or found.dtype not in (torch.float32, torch.float64):
        given = found.dtype if isinstance(found, Tensor) else type(found).__name__
        raise ValueError(f"{what} returns {given}; return a tensor of torch.float32 or torch.float64")
    return tuple(found.shape)


def choose_weight(
    held_out_nll: Callable[[float], float], first: float, *, factor: float = 2.0, most: int = 8, evidence: float = 0.0
) -> WeightChoice:
    """Find the weight with the lowest held-out NLL.

    A geometric ladder of weights brackets the minimum, and the vertex of a parabola is chosen.

    Args:
        held_out_nll: function that fits with a weight and returns the held-out NLL.
        first: initial weight.
        factor: ratio of neighbouring rungs.
        most: largest number of fits on the ladder; if they do not bracket the minimum, the lowest rung is chosen.
        evidence: the ladder also ends where a further rung lowers the NLL by less than this.
    """
    tried, rung = dict[float, float](), 0.0
    while rung not in tried and len(tried) < most:
        nll, before = held_out_nll(first * factor**rung), min(tried.values(), default=math.inf)
        tried[rung] = nll if math.isfinite(nll) else math.inf
        if 0 < before - nll < evidence:
            break
        best = min(tried, key=lambda each: tried[each])
        rung = best + 1 if best + 1 not in tried else best - 1
    vertex = best = min(tried, key=lambda rung: tried[rung])
    below, above = (tried.get(rung, math.inf) - tried[best] for rung in (best - 1, best + 1))
    if math.isfinite(below + above) and below + above > 0:
        vertex += 0.5 * (below - above) / (below + above)
    return WeightChoice(first * factor**vertex, {first * factor**rung: nll for rung, nll in tried.items()})


def choosing_weight(fit: Callable[_Given, FitResult]) -> Callable[_Given, FitResult]:
    """Decorator of a fit: ``weights="held-out"`` chooses the factor on the ``penalty()`` of its signal model. All fits start from
    the same models and hold out the same pixels, so that only the factor differs; the last one, with the chosen factor, is
    returned with the choice."""
    signature = inspect.signature(fit)

    @wraps(fit)
    def chosen(*args: _Given.args, **kwargs: _Given.kwargs) -> FitResult:
        given: dict[str, Any] = dict(signature.bind(*args, **kwargs).arguments)
        if not isinstance(given.get("weights"), str):
            return fit(*args, **kwargs)
        signal_model, generator = given["signal"], given.get("generator")
        if given.pop("weights") != HELD_OUT or not hasattr(signal_model, "penalty"):
            raise ValueError(f'weights is a tensor, or "{HELD_OUT}" for a signal model that has a penalty() to weight')
        if given.get("checkpoint") is not None or given.get("resume") is not None:
            raise ValueError("a choice of the weight keeps no checkpoints: choose it first, then fit with it")
        start, noise_model = copy.deepcopy(signal_model.state_dict()), given["noise_model"]
        generator_state = None if generator is None else generator.get_state()

        def fitted(weight: float, noise_model: nn.Module) -> FitResult:
            signal_model.load_state_dict(start)
            if generator is not None:
                generator.set_state(generator_state)
            models = {"noise_model": noise_model, "signal": WeightedPenalty(signal_model, weight)}
            return fit(**given | models)  # type: ignore[call-arg]

        @cache
        def held_out_nll(weight: float) -> float:  # a fit changes more of a noise model than its state
            return fitted(weight, copy.deepcopy(noise_model)).last_nll

        held_out = given.get("held_out", signature.parameters["held_out"].default)
        judged = float(held_out.sum()) if np.ndim(held_out) else held_out * math.prod(given["observation"].shape)
        # one nat of all held-out pixels together is no evidence
        options: dict[str, Any] = {"most": _MOST, "evidence": 1 / judged}
        wide = choose_weight(held_out_nll, 1.0, factor=_WIDE, **options).tried
        choice = choose_weight(held_out_nll, min(wide, key=lambda each: wide[each]), factor=math.sqrt(_WIDE), **options)
        result = fitted(choice.weight, noise_model)
        result.weight_choice = replace(choice, tried=wide | choice.tried)
        return result

    return chosen


class WeightedPenalty(nn.Module):
    """A signal model with a factor on its ``penalty()``; everything else is that of the model."""

    def __init__(self, model: nn.Module, weight: float) -> None:
        super().__init__()
        self.model, self.weight = model, weight

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("model"), name)

    def forward(self, pixels: Tensor) -> Tensor:
        predicted: Tensor = self.model(pixels)
        return predicted

    def penalty(self) -> Tensor:
        """The weighted penalty, nats per pixel."""
        penalty: Tensor = self.model.penalty()  # type: ignore[operator]
        return self.weight * penalty
