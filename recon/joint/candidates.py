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
from noiseflow.models.around import as_noise_model

_CLIPPED = 0.02
_FAR = 0.01  # of the contrast
_SHARED = 6  # Gaussians of a shape that all signals share: enough for a long tail on one side


def noise_candidates(images: NDArray[Any], *, quiet: bool = False) -> list[nn.Module]:
    """Noise models worth trying for these images, simplest first, behind the rounding and clipping limits that they show.

    All preserve the mean. Where clipping hides a tail of many pixels, a model whose whole shape depends on the signal could put
    anything there, and with it any mean. Then only those are offered whose shape is given or the same for all signals: what is
    seen at other signals stands in for what is hidden. Where there is little noise, most of what is left is what the volume
    cannot explain, and a noise model of learnt shape would learn to excuse it.

    Args:
        images: the pixel values.
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
    """Simple noise to start a fit with: where clipping hides pixel values, least squares would take their mean for the signal."""
    digitisation = detect_digitisation(images)
    return Digitised(SignalDependentGaussian(), *digitisation) if _clipped(images, digitisation) else Gaussian()


def _clipped(images: NDArray[Any], digitisation: Digitisation) -> bool:
    """Whether clipping hides much: many pixel values, and noise that takes their neighbours far from the clipping limits. A
    dark background at zero, whose noise is nothing beside the contrast, is as good as seen."""
    on_rail = (images <= digitisation.low) | (images >= digitisation.high)
    if on_rail.mean() < _CLIPPED:
        return False
    leaving = on_rail[..., 1:] != on_rail[..., :-1]
    steps = np.abs(images[..., 1:][leaving].astype(np.float32) - images[..., :-1][leaving])
    return bool(not steps.size or np.median(steps) > _FAR * images.std(dtype=np.float64))


def learns(noise_model: nn.Module) -> bool:
    """Whether a noise model has anything to learn."""
    return as_noise_model(noise_model).learns


def num_steps_of(noise_model: nn.Module, usual: int) -> int:
    """Steps of a fit of a noise model to an estimated signal: the usual number, or the most that the model asks for."""
    most = as_noise_model(noise_model).most_joint_steps
    return usual if most is None else min(usual, most)


def starts_anew(noise_model: nn.Module) -> bool:
    """Whether a noise model is standardised again on a better signal."""
    return as_noise_model(noise_model).starts_anew


def rate_of(noise_model: nn.Module) -> float:
    """The rate at which a noise model learns in a joint fit."""
    return as_noise_model(noise_model).joint_learning_rate
