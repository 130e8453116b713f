"""The result of a fit."""

import math
from dataclasses import dataclass, field

from torch import nn

from noiseflow.described import described
from noiseflow.models.digitisation import Digitisation


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
