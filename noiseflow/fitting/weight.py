"""Choice of the regulariser weight by the likelihood of held-out pixels."""

import copy
import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, wraps
from typing import Any, ParamSpec

import numpy as np
from torch import Tensor, nn

from noiseflow.fitting.steps import FitResult, WeightChoice

_Given = ParamSpec("_Given")
# Users state the scale of their penalty by guess: the first ladder reaches a thousandth and a thousand times of it. Wide rungs
# step over the lower minimum of noise that is too wide under a weight that is too low: 7 dB of one image denoised
_WIDE, _MOST = 16.0, 5
HELD_OUT = "held-out"


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
