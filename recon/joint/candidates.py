"""Candidate noise models of a joint fit, and their fit settings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import (
    Digitisation,
    Digitised,
    Gaussian,
    GaussianWithOutliers,
    Mixture,
    Poisson,
    PoissonGaussian,
    SignalDependentGaussian,
    SplineFlow,
    detect_digitisation,
)
from noiseflow.models.wrapper import as_noise_model

_CLIPPED = 0.02  # share of the pixels
_SHARED = 6  # Gaussians of a shape shared by all signals: enough for a long tail on one side
# electrons: signals stay this far above the end of counts, so that a single electron in vacuum is improbable (−6 nats), not
# impossible; a hundredth of the offset that matters
_DARK = 0.002
_BELOW = 3  # standard deviations; a clipped pixel with a signal further below the limit exceeds it once in 700 times


@dataclass(frozen=True)
class PixelValues:
    """What the pixel values of a whole series show without their signals.

    Attributes:
        digitisation: rounding and upper clipping limit.
        lowest: smallest pixel value, detector units.
        saturated: share of the pixels at the upper limit.
    """

    digitisation: Digitisation
    lowest: float
    saturated: float

    @staticmethod
    def of(images: NDArray[Any]) -> PixelValues:
        """The pixel values of images of any shape."""
        found = detect_digitisation(images)
        return PixelValues(found, float(images.min()), float((images >= found.high).mean()))

    def given(self, observation: Tensor, signal: Tensor, use: Tensor | None) -> Digitisation:
        """The digitisation with the lower clipping limit that pixels with predicted signals show, (tilt, u, y)."""
        low = detect_digitisation(observation, signal, use=use).low
        return self.digitisation._replace(low=low) if low <= self.lowest else self.digitisation

    def least_signal(self, noise_model: nn.Module) -> float:
        """The lowest signal that the pixel values allow.

        The mean of values that are not clipped is not below the lowest of them. A clipped signal may be below the limit, but not
        by more than the noise explains: further down, no pixel value would depend on it.
        """
        model = as_noise_model(noise_model)
        if not math.isfinite(model.low):
            return self.lowest + _DARK * model.step
        with torch.no_grad():
            at_limit = model.one_pixel(torch.full((1,), model.low, device=model.device))
            return model.low - _BELOW * float(at_limit.stddev)


def noise_candidates(digitisation: Digitisation, clipped: float, *, quiet: bool = False) -> list[nn.Module]:
    """Candidate noise models, simplest first, wrapped in rounding and clipping.

    All preserve the mean. If clipping hides a tail of many pixels, a shape that depends on the signal could have any hidden tail,
    and any mean: all candidates then have one shape. A learnt shape would absorb the misfit where noise is little. Counts are
    rounded and not clipped at the low end.

    Args:
        digitisation: rounding and clipping of the pixel values.
        clipped: share of the pixels at its limits.
        quiet: whether the noise is small compared with the contrast.
    """
    models: list[nn.Module] = [SignalDependentGaussian()]
    if not quiet:
        counts = [Poisson()] if digitisation.step > 0 and math.isinf(digitisation.low) else []
        # few bright pixels, which the regulariser lowers most, can bend any other width towards their misfit; a needle with 10
        # counts and read noise was as likely under such widths, as long as its signal was rough, and then 0.4 dB worse
        models = [*counts, SignalDependentGaussian(straight=True), PoissonGaussian(), *models]
        # outliers that would grow with the noise were taken for a mean of bright pixels: masses 3 to 15 % too high
        models.append(GaussianWithOutliers(mean_preserving=True))
        models.append(Mixture(_SHARED, shared_shape=True, mean_preserving=True))
    if not (quiet or clipped >= _CLIPPED):
        models += [Mixture(mean_preserving=True), SplineFlow(mean_preserving=True)]
    return [Digitised(model, *digitisation) for model in models] if digitisation.found else models


def first_noise(digitisation: Digitisation, clipped: float) -> nn.Module:
    """The simple noise model of the first fits. It includes clipping of many pixels, which would bias least squares."""
    return Digitised(SignalDependentGaussian(), *digitisation) if clipped >= _CLIPPED else Gaussian()
