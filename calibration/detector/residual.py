"""Residual of the short exposure from its signal: noise, offsets of rows and columns, and changes between the exposures."""

from dataclasses import dataclass

import numpy as np

from calibration.exposures.frames import Image, rounding_step
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import smoothed, spread_by_level
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import CLEAR, GAIN

BLUR = 1.5
"""Smoothing of a signal, pixels, which suppresses its noise."""


@dataclass(frozen=True)
class Residual:
    """Standardised residual of a pair's short exposure.

    Attributes:
        z: (..., y, x) residuals of one or several frames over the standard deviation at their level, clipped at `CLEAR`; 0
            outside the mask.
        mask: (y, x) valid pixels.
        share: share of the residual variance due to the noise of the signal, and to the gains of its pixels if they were removed.
        spread: (y, x) standard deviation at the level, counts.
        signal: (y, x) counts; None for frames without a scene.
        expected: (y, x) squares expected from each pixel's own signal, which the pixels of a mosaic do not share; None if all are
            equal.
        level: (y, x) signal of the neighbours, whose noise is independent of that of the pixel, counts; None without a scene.
    """

    z: Image
    mask: Mask
    share: float
    spread: Image
    signal: Image | None = None
    expected: Image | None = None
    level: Image | None = None


def residual_of(pair: AlignedPair) -> Residual:
    """Return the standardised residual of a pair, which is computed once."""
    known = vars(pair)
    if "_residual" not in known:
        known["_residual"] = _residual_of(pair)
    return known["_residual"]  # type: ignore[no-any-return]


def _residual_of(pair: AlignedPair, *, little: float = 0.1) -> Residual:
    part, kept = sum(pair.gains[1:2]), pair.kept  # gains of pixels deviate in both exposures
    share = (1 - part) * float(pair.share(pair.signal[pair.mask]).mean()) + part * kept / (1 + kept)
    # as little as the noise allows: at the same local average, a peak in the dark part of a crystal lattice is noisier than a
    # valley in the bright part
    blur = BLUR / 2 if share < little else BLUR
    difference, level = (pair.short - pair.signal)[pair.mask], smooth_signal(pair, blur=blur)[pair.mask]
    spread = np.ones(pair.mask.shape)
    spread[pair.mask] = np.interp(level, *spread_by_level(level, difference, step=rounding_step(pair.short)))
    z = np.zeros(pair.mask.shape)
    cut = np.clip(difference / spread[pair.mask], -CLEAR, CLEAR)
    z[pair.mask] = cut - cut.mean()  # the median of skewed noise differs from its mean, and would add a correlation
    scale = float(np.sqrt(np.mean(z[pair.mask] ** 2)))
    expected = pair.total_variance(pair.signal) / spread**2
    z = z / max(scale, np.finfo(float).tiny)
    return Residual(z, pair.mask, share, spread * scale, pair.signal, expected, pair.level)


def smooth_signal(pair: AlignedPair, *, blur: float = BLUR) -> Image:
    """Return the (y, x) signal smoothed with a Gaussian of `blur` pixels within the mask, counts."""
    weight = smoothed(pair.mask.astype(float), blur)
    inside = smoothed(np.where(pair.mask, pair.signal, 0.0), blur)
    middle = float(pair.signal[pair.mask].mean())
    return np.asarray(np.divide(inside, weight, out=np.full(inside.shape, middle), where=weight > 0.05))


def without_bands(
    residual: Image, z: Image, mask: Mask, *, axis: int, scene: bool = False, shape: Image | None = None
) -> tuple[Image, float]:
    """Subtract significant offsets of rows or columns in single frames, keeping the variance of the noise; return the offsets'
    standard deviation in that of the noise, too, or 0.

    Args:
        residual, z: (N, y, x) counts, from the mean of several frames, and the same over the standard deviation of the noise.
        axis: 2 for rows, 1 for columns.
        scene: whether slow changes from band to band belong to the scene.
        shape: (y, x) factor of the offsets in each pixel: its response, if the light changed; None for 1.
    """
    deviation, error = band_offsets(z, mask, axis=axis, scene=scene)
    if deviation**2 < max(CLEAR * error, GAIN / 2):  # they add their square to the variance
        return residual, 0.0
    factor = np.where(mask, 1.0 if shape is None else shape, 0.0)
    total = np.maximum((factor**2).sum(axis - 1, keepdims=True), 2 * (factor**2).max())
    offset = (residual * factor).sum(axis, keepdims=True) / total
    return (residual - offset * factor) / np.sqrt(1 - factor**2 / total), deviation


def band_offsets(
    z: Image, mask: Mask, *, axis: int, scene: bool, run: int = 16, smooth: int = 9
) -> tuple[float, float]:
    """Return the standard deviation of the offsets of rows or columns, and the standard error of its square without any, from the
    covariance of the means of even and odd runs of pixels along the band; arguments as `without_bands`."""
    frames, size = len(z), z.shape[axis]
    even = np.arange(size) // min(run, -(-size // 4)) % 2 == 0
    halves = np.stack([even, ~even]).astype(float)
    counts = halves @ np.moveaxis(mask, axis - 1, 0)
    known = counts.min(axis=0) >= min(run // 2, size // 3)
    number = int(known.sum()) * frames
    if number < 16:
        return 0.0, 1.0
    sums = np.stack([halves @ np.moveaxis(np.where(mask, one, 0.0), axis - 1, 0) for one in z], axis=1)
    means = (sums / np.maximum(counts, 1)[:, None])[..., known]
    means -= means.mean(axis=-1, keepdims=True)
    freedom = (1 - 1 / frames) if frames > 1 else 1.0
    if scene:
        slow = np.array([np.convolve(one, np.full(smooth, 1 / smooth), mode="same") for one in means.mean(axis=0)])
        means, freedom = means - slow, freedom * (1 - 1 / smooth)
    shared = float(np.mean(means[0] * means[1])) / freedom
    own = np.maximum(np.mean(means**2, axis=(1, 2)) / freedom - shared, 2 / size * np.mean(z[:, mask] ** 2))
    return float(np.sqrt(max(shared, 0.0))), float(np.sqrt(np.prod(own) / number))
