"""A joint fit as a list of stages: the signal by least squares, then by turns the noise at that signal and the signal.

Fitted together from a rough signal, they do not converge: the noise model describes the errors of the signal as outliers, and
pixels that could correct them lose their weight.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.fitting.loop import Checkpoint, FitResult
from noiseflow.fitting.signal_models import KnownSignal, predicted
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Gaussian
from noiseflow.progress import Progress

# Half of the steps are least squares, because outliers found in an unconverged signal are errors of the signal. Sinogram of
# 720 pixels with outliers, four Gaussians: 18 dB after a quarter and 25 after half of 300 steps; least squares has 20.
_SHARES = 1 / 2, 1 / 6, 1 / 6, 1 / 6
# Of noise models without a direct fit. Noise steps are cheap: they see a batch of pixels, not the whole signal.
_NOISE_STEPS = 100


def fit_in_stages(
    fit: Callable[..., FitResult],
    noise_model: NoiseModelBase,
    signal_model: nn.Module,
    observation: Tensor,
    *,
    num_steps: int,
    generator: torch.Generator,
    progress: Progress | None,
    checkpoint: Checkpoint | None,
    resume: dict[str, Any] | None,
    parameter_groups: Any,
    **shared: Any,
) -> FitResult:
    """Fit both models in place.

    Args:
        fit: `noiseflow.fit`.
        noise_model, signal_model, observation, num_steps, progress, checkpoint, resume, parameter_groups: as for `fit`.
        generator: source of one seed for each stage.
        shared: arguments of every fit.
    """
    seeds = torch.randint(2**62, (2 * len(_SHARES),), generator=generator).tolist()
    done, first = 0, 0 if resume is None else resume["stage"]
    result = FitResult(noise_model)
    for stage, share in enumerate(_SHARES):
        steps = max(1, round(share * num_steps))
        done, begun = done + steps, done
        if stage < first:
            continue

        def report(task: str, step: int, _: int, note: str, begun: int = begun) -> None:
            if progress is not None:
                progress(task, begun + step, max(num_steps, begun + step), note)

        def keep(state: dict[str, Any], stage: int = stage) -> None:
            if checkpoint is not None:
                checkpoint(state | {"stage": stage})

        if stage and (resume is None or stage > first):
            steps_of_noise = None if noise_model.fits_directly else _NOISE_STEPS
            options = {"num_steps": steps_of_noise, "learning_rate": noise_model.joint_learning_rate}
            fit(
                noise_model,
                KnownSignal(predicted(signal_model, observation)),
                observation,
                generator=torch.Generator().manual_seed(seeds[2 * stage]),
                **options,
                **shared,
            )
        result = fit(
            noise_model if stage else Gaussian().to(observation.device),
            signal_model,
            observation,
            num_steps=steps,
            train_noise=not stage,
            standardise=not stage,
            generator=torch.Generator().manual_seed(seeds[2 * stage + 1]),
            progress=report,
            checkpoint=None if checkpoint is None else keep,
            resume=resume if stage == first else None,
            parameter_groups=parameter_groups,
            **shared,
        )
    result.num_steps = done
    return result
