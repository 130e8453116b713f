"""Steps of a fit: single optimiser steps, skipped if not finite, the best of the states that they lead to, and the result."""

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from noiseflow.described import described
from noiseflow.models.digitisation import Digitisation


def _without_compiler(kind: type[torch.optim.Optimizer]) -> Any:
    """An optimiser class without torch's compiler guards, whose first call loads the compiler and takes seconds."""
    names = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
    methods = {name: inspect.unwrap(getattr(kind, name)) for name in names}
    return type(kind.__name__, (kind,), methods | {"step": torch.no_grad()(inspect.unwrap(kind.step))})


_Adam, _LBFGS = _without_compiler(torch.optim.Adam), _without_compiler(torch.optim.LBFGS)


def adam(groups: Iterable[dict[str, Any]]) -> torch.optim.Optimizer:
    """Adam with a short memory of squared gradients, unless a group has ``betas`` of its own."""
    optimiser: torch.optim.Optimizer = _Adam(list(groups), betas=(0.9, 0.99), fused=True)
    return optimiser


def lbfgs(parameters: Iterable[Tensor], **options: Any) -> torch.optim.LBFGS:
    """L-BFGS with a strong-Wolfe line search, which ends at steps that change the loss or all parameters by less than 1e-9."""
    optimiser: torch.optim.LBFGS = _LBFGS(list(parameters), line_search_fn="strong_wolfe", **options)
    return optimiser


def take_step(optimiser: torch.optim.Optimizer, loss: Callable[[], Tensor]) -> bool:
    """Take one optimiser step. Return False, without a step, if loss or gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    value = loss()
    value.backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    # one number, because a GPU is waited for at each that Python reads
    total = torch.stack([value.detach(), *(gradient.sum().to(value) for gradient in gradients)]).sum()
    if not math.isfinite(float(total)):
        return False
    optimiser.step()
    return True


def snapshot(model: nn.Module) -> dict[str, Any]:
    """A copy of the state of a model, in a tenth of the time of ``copy.deepcopy``."""
    return {name: tensor.clone() for name, tensor in model.state_dict().items()}


class BestState:
    """The state that a fit returns. This is the latest state that no earlier one beats on the held-out pixels by more than a
    number of standard errors of the difference, see `ALLOWED`."""

    ALLOWED: ClassVar[dict[str, tuple[float, float]]] = {"noise": (0, 1), "joint": (1, 0), "last": (3, 3)}
    """Standard errors by which a state may be behind the initial state, if that leads, and behind another one that leads.

    Of a ``noise`` model alone, the initial state is kept if it is the best of all. In a ``joint`` fit it must be significantly
    better, because the signal comes from a fit to other noise, and optimisation steps are more reliable than an insignificant
    comparison. ``last``: a penalty prevents overfitting; only a divergence counts.
    """

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self._scores: Tensor | None = None
        self._start_leads = True

    def judge(self, state: dict[str, Any], scores: Tensor, *, start: bool, kind: str) -> bool:
        """Compare a state by its log-likelihoods of the held-out pixels, (P,). Return whether it is now the chosen one."""
        if self._scores is None:
            self._scores, self._start_leads, self.state = scores, start, state
            return True
        behind = self._scores - scores
        error = float(behind.std(correction=0)) / math.sqrt(behind.numel())
        leads = not float(behind.mean()) > 0
        beside_start, otherwise = self.ALLOWED[kind]
        if not leads and float(behind.mean()) > error * (beside_start if self._start_leads else otherwise):
            return False
        if leads:
            self._scores, self._start_leads = scores, False
        self.state = state
        return True

    def saved(self) -> dict[str, Any]:
        """The state for `load`."""
        return {"state": self.state, "scores": self._scores, "start_leads": self._start_leads}

    def load(self, saved: dict[str, Any]) -> None:
        """Restore what `saved` returned."""
        self.state, self._scores, self._start_leads = saved["state"], saved["scores"], saved["start_leads"]


@described()
@dataclass(frozen=True)
class WeightChoice:
    """A weight and the evidence for it.

    Attributes:
        tried: weight → held-out negative log-likelihood, nats per pixel, in the order tried.
    """

    weight: float
    tried: dict[float, float]


@described(held_out_nll="nats per pixel", seconds="s", table_error="nats per pixel")
@dataclass
class FitResult:
    """The result of a fit.

    Attributes:
        noise_model: the fitted model, wrapped in `Digitised` if rounding or clipping was detected.
        digitisation: the detected rounding and clipping limits; none if the model was not wrapped.
        held_out_nll: mean negative log-likelihood of the held-out pixels, nats per pixel.
        num_steps: steps taken.
        seconds: wall time.
        recoveries: number of non-finite steps that were undone and repeated with half the learning rate.
        history: step → held-out NLL, in order of measurement.
        table_error: interpolation error of the tabulated likelihood, nats per pixel; None if no table was used.
        weight_choice: the chosen weight of the penalty and those it was compared with, if ``weights="held-out"``.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(1.0, 5.0, 4000)
        >>> observation = noiseflow.Gaussian(0.5)(signal).sample(generator=torch.Generator().manual_seed(0))
        >>> result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=100)
        >>> round(result.held_out_nll, 1)
        0.7
    """

    noise_model: nn.Module
    digitisation: Digitisation = field(default_factory=Digitisation)
    held_out_nll: float = math.nan
    num_steps: int = 0
    seconds: float = 0.0
    recoveries: int = 0
    history: dict[int, float] = field(default_factory=dict)
    table_error: float | None = None
    weight_choice: WeightChoice | None = None

    @property
    def last_nll(self) -> float:
        """Held-out NLL after the last step, nats per pixel; infinite if it is NaN or there was no step."""
        nll = next(reversed(self.history.values()), math.inf)
        return nll if math.isfinite(nll) else math.inf
