"""Candidate noise models of a joint fit, and their fit settings."""

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
from noiseflow.models.wrapper import as_noise_model

_CLIPPED = 0.02
_FAR = 0.01  # noise relative to the contrast
_SHARED = 6  # Gaussians of a shape shared by all signals: enough for a long tail on one side


def noise_candidates(images: NDArray[Any], *, quiet: bool = False) -> list[nn.Module]:
    """Candidate noise models for these images, simplest first, wrapped in the detected rounding and clipping.

    All of them preserve the mean. If clipping hides a tail of many pixels, a model whose shape depends on the signal could have
    any hidden tail, and therefore any mean. In this case only models with a fixed shape, or one shared by all signals, are
    candidates: the visible tails at other signals determine the hidden ones. If there is little noise, the residuals are mostly
    misfit of the volume, and a noise model with a learnt shape would absorb it.

    Args:
        images: the pixel values.
        quiet: whether the noise is small compared with the contrast.
    """
    digitisation = detect_digitisation(images)
    models: list[nn.Module] = [SignalDependentGaussian()]
    if not quiet:
        models += [PoissonGaussian(), Mixture(_SHARED, shared_shape=True, mean_preserving=True)]
    if not (quiet or _clipped(images, digitisation)):
        models += [Mixture(mean_preserving=True), SplineFlow(mean_preserving=True)]
    return [Digitised(model, *digitisation) for model in models] if digitisation.found else models


def first_noise(images: NDArray[Any]) -> nn.Module:
    """The simple noise model of the first fits. It includes clipping, which would bias least squares."""
    digitisation = detect_digitisation(images)
    return Digitised(SignalDependentGaussian(), *digitisation) if _clipped(images, digitisation) else Gaussian()


def _clipped(images: NDArray[Any], digitisation: Digitisation) -> bool:
    """Whether clipping hides much: many pixel values are clipped, and the noise is significant compared with the contrast. A
    dark background at zero with negligible noise does not count."""
    on_rail = (images <= digitisation.low) | (images >= digitisation.high)
    if on_rail.mean() < _CLIPPED:
        return False
    leaving = on_rail[..., 1:] != on_rail[..., :-1]
    steps = np.abs(images[..., 1:][leaving].astype(np.float32) - images[..., :-1][leaving])
    return bool(not steps.size or np.median(steps) > _FAR * images.std(dtype=np.float64))


def learns(noise_model: nn.Module) -> bool:
    """Whether a noise model has trainable parameters."""
    return as_noise_model(noise_model).learns


def num_steps_of(noise_model: nn.Module, usual: int) -> int:
    """Steps of a fit of a noise model to an estimated signal: the usual number, limited to the maximum of the model."""
    most = as_noise_model(noise_model).most_joint_steps
    return usual if most is None else min(usual, most)


def starts_anew(noise_model: nn.Module) -> bool:
    """Whether a noise model is standardised again when the signal has improved."""
    return as_noise_model(noise_model).starts_anew


def rate_of(noise_model: nn.Module) -> float:
    """The learning rate of a noise model in a joint fit."""
    return as_noise_model(noise_model).joint_learning_rate
