"""The first stages of a joint fit: the signal by least squares, then the noise at that signal.

Together, from a rough signal, they do not converge: the noise model describes the errors of the signal as outliers, and pixels
that could correct them lose their weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.fitting.loop import FitLoop, FitResult, LoopSettings
from noiseflow.fitting.pixel_split import FitPixels
from noiseflow.fitting.signal_models import KnownSignal
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Gaussian
from noiseflow.threads import few_threads

SHARE = 0.25
"""Share of the steps of a joint fit that are least squares, as in the fit of a volume."""
# Noise steps are cheap: they see a batch of pixels, not the whole signal.
_NOISE_STEPS = 100


def begin(
    noise_model: NoiseModelBase,
    signal_model: nn.Module,
    pixels: FitPixels,
    settings: LoopSettings,
    *,
    learning_rate: float,
    parameter_groups: Sequence[dict[str, Any]] | None,
) -> None:
    """Fit the signal model by least squares, then the noise model to its residuals, both in place.

    Args:
        noise_model, signal_model, pixels: those of the joint fit.
        settings: the number of least-squares steps, and the other settings of the joint fit.
        learning_rate: learning rate of noise models, and of a signal model without parameter groups.
        parameter_groups: parameter groups of the signal model, instead of its own.
    """
    simple = Gaussian().to(noise_model.device)
    signal_loop = FitLoop(simple, signal_model, pixels, FitResult(simple))
    signal_loop.prepare(learning_rate, standardise=True, parameter_groups=parameter_groups)
    signal_loop.run(settings, None, None)
    noise_loop = FitLoop(noise_model, KnownSignal(_signal(signal_model, pixels)), pixels, FitResult(noise_model))
    noise_loop.prepare(noise_model.joint_learning_rate, standardise=True)
    with few_threads(settings.batch_size):
        noise_loop.run(replace(settings, num_steps=_NOISE_STEPS), None, None)


@torch.no_grad()
def _signal(signal_model: nn.Module, pixels: FitPixels) -> Tensor:
    whole: Tensor = (
        signal_model.signal()  # type: ignore[operator]
        if hasattr(signal_model, "signal")
        else signal_model(torch.arange(pixels.observation.numel(), device=pixels.observation.device))
    )
    return whole.detach().clone()
