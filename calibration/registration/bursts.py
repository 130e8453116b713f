"""Bursts of equal exposures: measure drift and dose, and compare every frame with the mean of the others."""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Burst, Image, rounding_step
from calibration.exposures.masks import Mask, MaskCounts, clear_of_rails, defects, restless, saturated, without_outliers
from calibration.exposures.scaling import MOST_PIXELS, Scaling, VarianceLine, fit_scaling, ring_mean, smoothed
from calibration.registration.align import Registration, register
from calibration.registration.aligned import MINIMUM_PIXELS, AlignedPair
from calibration.tolerances import CLEAR, LIKELY, MISALIGNED, MOST_LEFT_OUT, SCENE
from noiseflow.described import described


@described(shift="px", drift="px", dose="of the mean", dose_error="of the mean")
@dataclass(frozen=True)
class BurstReport:
    """Drift and dose along a burst.

    Attributes:
        shift: (frame, 2) displacement (x, y) of each frame from the mean, pixels; NaN if the scene has too few features.
        drift: largest displacement between two frames, pixels; NaN if unknown.
        dose, dose_error: (frame,) dose of each frame relative to the mean, and its standard error.
        drifting: whether the frames were registered before they were compared.
        fading: whether the dose changes by more than its errors and `SCENE`.
        outliers: number of values that stood out in one frame only and were replaced.
    """

    shift: Image
    drift: float
    dose: Image
    dose_error: Image
    drifting: bool
    fading: bool
    outliers: int


def align_burst(burst: Burst) -> tuple[list[AlignedPair], BurstReport]:
    """Pair every frame with the mean of the others, which are warped onto it if the burst drifts.

    The mean of n − 1 frames is noisy too, so the variance of the difference is n/(n − 1) times that of the frame. The
    `observation` of each pair is corrected for this factor.

    Returns:
        One pair per frame, and the drift and dose of the burst.

    Raises:
        ValueError: too few pixels are valid, or the scene changes between frames.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> calibration.align_burst(calibration.Burst(frames))[1].drifting
        False
    """
    frames, outliers = without_outliers(burst.frames)
    hot, dead = defects(frames)
    trusted = ~(hot | dead | np.any([saturated(frame) for frame in frames], axis=0))
    # select by the mean: a selection by single pixel values would truncate their noise
    if trusted.any():
        trusted &= clear_of_rails(frames[0], frames.mean(0), trusted, upper_only=True)
    if trusted.sum() < MINIMUM_PIXELS:
        raise ValueError(f"only {int(trusted.sum())} pixels of {burst.name} can be used; use unsaturated frames")
    registrations = _registrations(frames)
    shift = np.array([found.shift(frames[0].shape) if found else (np.nan, np.nan) for found in registrations])
    drift, drifting = _drift(shift, registrations)
    references, moving = _compared(frames, np.zeros_like(shift), trusted, mosaic=False)
    noise: list[Image | None] = [None] * len(frames)
    if drifting:
        mosaic = any(one.mosaic for one in registrations if one)
        shift = _refined(frames, shift, mosaic)
        moved, moving_then = _compared(frames, shift, trusted, mosaic)
        drifting = bool(moving_then.sum() <= moving.sum())  # otherwise a change of the scene was mistaken for drift
        if drifting:
            references, moving, noise = moved, moving_then, _of_white_noise(shift, frames[0].shape, mosaic)
    _require_still(moving, trusted, burst.name)
    pairs = []
    for frame, (others, covered), registration, white in zip(frames, references, registrations, noise, strict=True):
        lost = (~covered, ~trusted & ~hot & ~dead, hot, dead, moving, np.zeros_like(hot))
        counts = MaskCounts(*(int(mask.sum()) for mask in lost))
        mask = trusted & covered & ~moving
        own = {"registration": registration or _still(), "counts": counts, "frames": len(frames), "white": white}
        pairs.append(_pair(frame, others, mask, **own))
    dose = np.array([pair.scaling.slope for pair in pairs])
    error = np.array([pair.scaling.slope_error for pair in pairs])
    fading = bool(np.any(np.abs(dose - 1) > np.maximum(LIKELY * error, SCENE)))
    return pairs, BurstReport(shift, drift, dose, error, drifting, fading, outliers)


def _registrations(frames: Image) -> list[Registration | None]:
    """Register each frame to the mean of the others; all None if the first, middle and last frames cannot be registered, as for
    flats and faint scenes."""
    found: dict[int, Registration | None] = {}
    last, near, total = len(frames) - 1, None, frames.sum(0)
    for index in dict.fromkeys((0, len(frames) // 2, last, *range(last))):
        near = found.get(index - 1) or near  # the frame before, or a probe
        found[index] = None
        if len(found) <= 3 or any(found.values()):
            with suppress(ValueError):  # too few features
                found[index] = near = register(frames[index], (total - frames[index]) / last, near=near)
    return [found[index] for index in range(len(frames))]


def _refined(frames: Image, shift: Image, mosaic: bool) -> Image:
    """Measure the shifts again, from the means of frames that lie on each other: drift blurs the others, and moves their mean."""
    found = np.zeros_like(shift)
    for index, frame in enumerate(frames):
        others, _ = _others_on(frames, shift, index, mosaic)
        with suppress(ValueError):
            found[index] = register(frame, others, near=_still()).shift(frame.shape)
    return np.asarray(shift + found - found.mean(axis=0))


def _drift(shift: Image, registrations: list[Registration | None]) -> tuple[float, bool]:
    known = [found for found in registrations if found is not None]
    if len(known) < 2:
        return float("nan"), False
    seen = shift[np.isfinite(shift).all(1)]
    drift = float(np.linalg.norm(seen[:, None] - seen[None], axis=-1).max())
    error = max(found.error_px for found in known)
    return drift, drift > max(MISALIGNED, CLEAR * error) and len(known) == len(registrations)


def _compared(frames: Image, shift: Image, trusted: Mask, mosaic: bool) -> tuple[list[tuple[Image, Mask]], Mask]:
    """Return the mean of the others warped onto each frame with the mask it covers, and the mask of regions that change."""
    references = [_others_on(frames, shift, index, mosaic) for index in range(len(frames))]
    covered = np.logical_and.reduce([mask for _, mask in references]) & trusted
    residual = np.stack([_residual(frame, mean, covered) for frame, (mean, _) in zip(frames, references, strict=True)])
    level = ring_mean(frames.mean(axis=0), covered)
    return references, restless(residual, level, covered, step=rounding_step(frames[0]))


def _residual(frame: Image, others: Image, mask: Mask) -> Image:
    """Subtract the mean of the others, scaled to the frame's dose, from a frame."""
    first, second = (smoothed(image, 2.0)[mask] for image in (frame, others))
    slope = np.cov(first, second)[0, 1] / max(np.var(second), np.finfo(float).tiny)
    if np.std(second) < 0.1 * np.std((frame - others)[mask]):  # a flat scene has no slope
        slope = 1.0
    return np.asarray(frame - slope * others - (frame - slope * others)[mask].mean())


def _require_still(moving: Mask, trusted: Mask, name: str) -> None:
    share = float(moving.sum() / trusted.sum())
    if share > MOST_LEFT_OUT:
        raise ValueError(
            f"{name}: the scene changes between frames at {share:.0%} of its pixels (blinking, moving or bleaching objects), "
            "and the change would be counted as noise; use frames of a static scene, or a static part of it (--region)"
        )


def _of_white_noise(shift: Image, shape: tuple[int, ...], mosaic: bool) -> list[Image | None]:
    """Differences of frames of white noise of unit variance from the mean of the others, warped as those of the burst: their
    variance and correlations are those that interpolation leaves, known to 0.0014."""
    height, width = (min(size, int(np.sqrt(2 * MOST_PIXELS / len(shift)))) for size in shape)
    white = np.random.default_rng(0).standard_normal((len(shift), height, width))
    return [white[index] - _others_on(white, shift, index, mosaic)[0] for index in range(len(shift))]


def _others_on(frames: Image, shift: Image, index: int, mosaic: bool) -> tuple[Image, Mask]:
    """Mean of the other frames, each shifted onto frame `index`, and the mask of pixels that all of them cover.

    The mean of the others is displaced by −1/(n − 1) times the frame's own displacement, so the shift measured against it is
    n/(n − 1) times the displacement from the mean of all frames.
    """
    if not shift.any():
        return (frames.sum(0) - frames[index]) / (len(frames) - 1), np.ones(frames[0].shape, bool)
    displacement = shift * (len(shift) - 1) / len(shift)
    total, covered = np.zeros(frames[0].shape), np.ones(frames[0].shape, bool)
    for other in set(range(len(frames))) - {index}:
        matrix = np.column_stack([np.eye(2), displacement[index] - displacement[other]])
        moved, inside = replace(_still(matrix), mosaic=mosaic).warp(frames[other])
        total += moved
        covered &= inside
    return total / (len(frames) - 1), covered


def _pair(frame: Image, others: Image, mask: Mask, **own: Any) -> AlignedPair:
    try:
        scaling = fit_scaling(frame, others, mask, burst=True)
    except ValueError:  # a flat scene has no slope; only its level can be matched
        above = (frame - others)[mask]
        scaling = Scaling(1.0, float(above.mean()), 0.0, float(above.std() / np.sqrt(above.size)), 0.0, 0.0)
    signal = scaling.slope * others + scaling.intercept
    total = VarianceLine.fitted(signal[mask], ((frame - signal) ** 2)[mask])
    pair = AlignedPair(frame, others, signal, mask, scaling=scaling, total_variance=total, signal_variance=total, **own)
    share = pair.kept / (pair.frames - 1 + pair.kept)
    return replace(pair, signal_variance=VarianceLine(share * total.floor, share * total.rate))


def _still(matrix: NDArray[np.float64] | None = None) -> Registration:
    matrix = np.eye(2, 3) if matrix is None else matrix
    return Registration(matrix, "translation", "phase correlation", 0, 0, float("nan"), float("nan"), 0.0, False)
