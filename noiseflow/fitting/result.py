"""What a fit reached."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torch import nn

from noiseflow.described import described
from noiseflow.models.digitisation import Digitisation


@described(held_out_nll="nats per pixel", seconds="s", table_error="nats per pixel")
@dataclass
class FitResult:
    """What a fit reached.

    Attributes:
        noise_model: the fitted model: the one given, behind a `Digitised` where rounding or clipping limits were found.
        digitisation: the rounding and clipping limits it was put behind; none where it was left as it is.
        held_out_nll: mean negative log-likelihood of the held-out pixels, nats per pixel.
        num_steps: steps taken.
        seconds: wall time.
        recoveries: how often a non-finite step was undone with half the learning rate.
        history: step → held-out NLL, in the order measured.
        table_error: interpolation error of the tabulated likelihood, nats per pixel; None where none was used.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(1.0, 5.0, 4000)
        >>> observation = noiseflow.Gaussian(0.5)(signal).sample(generator=torch.Generator().manual_seed(0))
        >>> result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=100)
        >>> round(result.held_out_nll, 1), result.num_steps
        (0.7, 100)
    """

    noise_model: nn.Module
    digitisation: Digitisation = field(default_factory=Digitisation)
    held_out_nll: float = math.nan
    num_steps: int = 0
    seconds: float = 0.0
    recoveries: int = 0
    history: dict[int, float] = field(default_factory=dict)
    table_error: float | None = None
