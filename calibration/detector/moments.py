"""Temporal and spatial moments of equal frames, the basis of the camera figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.exposures.frames import Burst, Image, rails, rounding_step
from calibration.tolerances import CLEAR, CLIPPED
from noiseflow.described import described


@described(mean="counts", variance="counts²", spatial="counts²", variance_error="counts²")
@dataclass(frozen=True)
class Level:
    """Temporal and spatial moments of equal frames.

    Attributes:
        mean: counts.
        variance: temporal variance, averaged over pixels, without rounding noise, counts².
        variance_error: standard error of `variance`, counts².
        third: third central temporal moment, counts³; None for two frames.
        third_error: standard error of `third`, counts³.
        spatial: spatial variance of the mean frame, without the contribution of temporal noise, counts².
        image: (y, x) mean frame, counts.
        noise: (y, x) temporal variance of each pixel, counts².
        frames: number of frames.
        flicker: relative standard deviation of the frame means, without the contribution of pixel noise.
        clipped: share of pixel values at either clipping limit.
        coarse: whether the noise is too small, relative to the rounding step, to measure its variance.
        end: upper clipping limit, counts; infinite if no pixel value reaches it.
    """

    mean: float
    variance: float
    variance_error: float
    third: float | None
    third_error: float
    spatial: float
    image: Image
    noise: Image
    frames: int
    flicker: float
    clipped: float
    coarse: bool
    end: float


def level_of(burst: Burst, *, coarse: float = 0.24) -> Level:
    """Compute the moments of equal frames.

    Args:
        burst: the frames.
        coarse: variance, in squared rounding steps and including rounding noise, below which it depends on the position of the
            mean between two codes (EMVA 1288, release 3.1, section 6.5).
    """
    frames, number = burst.frames, len(burst.frames)
    image, noise = frames.mean(0), frames.var(axis=0, ddof=1)
    rounding = rounding_step(frames[0]) ** 2 / 12
    means = frames.mean(axis=(1, 2))
    drift = float(means.var(ddof=1)) - float(noise.mean()) / image.size  # light that changed between frames
    if drift < CLEAR * float(noise.mean()) / image.size * np.sqrt(2 / (number - 1)):
        drift = 0.0
    variance = float(noise.mean()) - drift
    residual = frames - image
    shrunk = 1.0
    if image.size > 2:  # a frame's mean over N pixels takes part of the third moment with it
        residual = residual - (means - means.mean())[:, None, None]
        shrunk = (1 - 1 / image.size) * (1 - 2 / image.size)
    fourth = float(np.mean(residual**4)) * (number / (number - 1)) ** 2 if number > 2 else 3 * variance**2
    error = np.sqrt(max(fourth - variance**2, 0.5 * variance**2) / (image.size * (number - 1)))
    third, third_error = None, 0.0
    if number > 2:
        scale = number**2 / ((number - 1) * (number - 2)) / shrunk  # unbiased third central moment
        cubes = residual**3 * scale
        third, third_error = float(cubes.mean()), float(cubes.std() / np.sqrt(cubes.size))
    spatial = float(image.var(ddof=1)) - float(noise.mean()) / number
    low, end = rails(frames) if np.ptp(frames) > 0 else (-np.inf, float(frames.flat[0]))
    clipped = float(np.mean((frames <= low) | (frames >= end)))
    flicker = float(np.sqrt(drift) / max(abs(float(means.mean())), np.finfo(float).tiny))
    return Level(
        float(image.mean()),
        variance - rounding,
        float(error),
        third,
        third_error,
        spatial,
        image,
        noise,
        number,
        flicker,
        clipped if clipped > CLIPPED else 0.0,
        bool(variance < coarse * 12 * rounding),
        end,
    )
