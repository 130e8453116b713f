"""Noise models that a joint fit chooses from, and how each is best fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from noiseflow import (
    Digitisation,
    Digitised,
    Gaussian,
    Mixture,
    PoissonGaussian,
    SignalDependentGaussian,
    SplineFlow,
    detect_digitisation,
)

_CLIPPED = 0.02
_FAR = 0.01  # of the contrast
_SHARED = 6  # Gaussians of a shape that all signals share: enough for a long tail on one side
_EXACT_STEPS = 15


def noise_candidates(images: NDArray[Any], *, quiet: bool = False) -> list[nn.Module]:
    """Noise models worth trying for these images, simplest first, behind the rounding and rails that they show.

    All preserve the mean. Where clipping hides a tail of many pixels, a model whose whole shape depends on the signal could put
    anything there, and with it any mean. Then only those are offered whose shape is given or the same for all signals: what is
    seen at other signals stands in for what is hidden. Where there is little noise, most of what is left is what the volume
    cannot explain, and a noise model of learnt shape would learn to excuse it.

    Args:
        images: the readings.
        quiet: whether noise is small beside the contrast.
    """
    digitisation = detect_digitisation(images)
    models: list[nn.Module] = [SignalDependentGaussian()]
    if not quiet:
        models += [PoissonGaussian(), Mixture(_SHARED, shared_shape=True, mean_preserving=True)]
    if not (quiet or _clipped(images, digitisation)):
        models += [Mixture(mean_preserving=True), SplineFlow(mean_preserving=True)]
    return [Digitised(model, *digitisation) for model in models] if digitisation.found else models


def first_noise(images: NDArray[Any]) -> nn.Module:
    """Simple noise to start a fit with: where clipping hides readings, least squares would take their mean for the signal."""
    digitisation = detect_digitisation(images)
    return Digitised(SignalDependentGaussian(), *digitisation) if _clipped(images, digitisation) else Gaussian()


def _clipped(images: NDArray[Any], digitisation: Digitisation) -> bool:
    """Whether clipping hides much: many readings, and noise that takes their neighbours far from the rails. A dark background
    at zero, whose noise is nothing beside the contrast, is as good as seen."""
    on_rail = (images <= digitisation.low) | (images >= digitisation.high)
    if on_rail.mean() < _CLIPPED:
        return False
    leaving = on_rail[..., 1:] != on_rail[..., :-1]
    steps = np.abs(images[..., 1:][leaving].astype(np.float32) - images[..., :-1][leaving])
    return bool(not steps.size or np.median(steps) > _FAR * images.std(dtype=np.float64))


def learns(noise_model: nn.Module) -> bool:
    """Whether a noise model has anything to learn."""
    return any(parameter.requires_grad for parameter in noise_model.parameters())


def num_steps_of(noise_model: nn.Module, usual: int) -> int:
    """The exact sum over electrons takes long, but it starts at its most likely parameters."""
    exact = any(isinstance(module, PoissonGaussian) for module in noise_model.modules())
    return min(usual, _EXACT_STEPS) if exact else usual


def starts_anew(noise_model: nn.Module) -> bool:
    """Whether it had better start from scratch on a better signal: a Gaussian's width at every signal is read off the residuals,
    and a fit that went on from the width about a worse signal would hardly move."""
    return any(isinstance(module, SignalDependentGaussian) for module in noise_model.modules())


def rate_of(noise_model: nn.Module) -> float:
    """Models of many parameters overshoot at rates that the others need to keep up with the volume."""
    rich = any(isinstance(module, SplineFlow | Mixture) for module in noise_model.modules())
    return 0.01 if rich else 0.03
