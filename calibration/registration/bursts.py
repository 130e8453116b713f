"""Bursts of equal exposures: drift and dose found, and every frame set beside the mean of the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.exposures.frames import Burst, Image
from calibration.exposures.masks import Mask, MaskCounts, clear_of_rails, defects, restless, saturated
from calibration.exposures.scaling import Scaling, VarianceLine, fit_line, fit_scaling
from calibration.registration.align import Registration, register
from calibration.registration.aligned import MINIMUM_PIXELS, AlignedPair
from noiseflow.described import described

LEAST_DRIFT = 0.1
"""Pixels below which a burst counts as still: warping would cost more than it mends."""

LARGEST_CHANGE = 0.05
"""Share of the pixels that may lie in places which change."""

LEAST_DOSE_CHANGE = 0.005
"""Relative dose change below which a burst counts as steady."""


@described(shift="px", drift="px", dose="of the mean", dose_error="of the mean")
@dataclass(frozen=True)
class BurstReport:
    """What moved or faded along a burst.

    Attributes:
        shift: (frame, 2) displacement (x, y) of each frame from the mean, pixels; NaN where the scene has too few
            features to tell.
        drift: largest distance between two frames, pixels; NaN if unknown.
        dose: (frame,) dose of each frame relative to the mean.
        dose_error: (frame,) standard errors.
        drifting: the frames were registered before they were compared.
        fading: the dose changes by more than its errors and `LEAST_DOSE_CHANGE`.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> _, report = calibration.align_burst(calibration.Burst(frames))
        >>> report.drifting, report.fading, report.dose.round(2).tolist()
        (False, False, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    """

    shift: Image
    drift: float
    dose: Image
    dose_error: Image
    drifting: bool
    fading: bool


def align_burst(burst: Burst) -> tuple[list[AlignedPair], BurstReport]:
    """Set every frame beside the mean of the others, which are warped onto it if the burst drifts.

    The mean of n − 1 frames is noisy itself, so that the difference scatters n/(n − 1) times as much as the frame.
    Each pair's `observation` is shrunk by that factor.

    Args:
        burst: two equal exposures or more.

    Returns:
        One pair per frame, and what moved or faded.

    Raises:
        ValueError: too few pixels can be trusted.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, report = calibration.align_burst(calibration.Burst(frames))
        >>> len(pairs), report.drifting
        (6, False)
    """
    frames = burst.frames
    hot, dead = defects(frames)
    trusted = ~(hot | dead | np.any([saturated(frame) for frame in frames], axis=0))
    if (
        trusted.any()
    ):  # a choice by single pixel values would cut their noise; their mean tells nothing of their differences
        trusted &= clear_of_rails(frames[0], frames.mean(0), trusted, upper_only=True)
    if trusted.sum() < MINIMUM_PIXELS:
        raise ValueError(
            f"only {int(trusted.sum())} pixels of {burst.name} can be used; give frames that are not saturated"
        )
    registrations = _registrations(frames)
    shift = np.array([found.shift(frames[0].shape) if found else (np.nan, np.nan) for found in registrations])
    drift, drifting = _drift(shift, registrations)
    references, moving = _compared(frames, np.zeros_like(shift), trusted)
    if drifting:
        moved, moving_then = _compared(frames, shift, trusted)
        drifting = bool(moving_then.sum() <= moving.sum())  # else what changes in the scene looked like a drift
        references, moving = (moved, moving_then) if drifting else (references, moving)
    _require_still(moving, trusted, burst.name)
    pairs = []
    for frame, (others, covered), registration in zip(frames, references, registrations, strict=True):
        lost = (~covered, ~trusted & ~hot & ~dead, hot, dead, moving)
        counts = MaskCounts(*(int(mask.sum()) for mask in lost))
        mask = trusted & covered & ~moving
        pairs.append(_pair(frame, others, mask, registration or _still(), counts, len(frames)))
    dose = np.array([pair.scaling.slope for pair in pairs])
    error = np.array([pair.scaling.slope_error for pair in pairs])
    fading = bool(np.any(np.abs(dose - 1) > np.maximum(3 * error, LEAST_DOSE_CHANGE)))
    return pairs, BurstReport(shift, drift, dose, error, drifting, fading)


def _registrations(frames: Image) -> list[Registration | None]:
    """Where each frame lies in the mean of the others; all None where the first, the middle and the last one find nothing to
    register by, as flats and faint scenes."""
    probes = {index: _registered(frames, index) for index in (0, len(frames) // 2, len(frames) - 1)}
    if not any(probes.values()):
        return [None] * len(frames)
    return [probes[index] if index in probes else _registered(frames, index) for index in range(len(frames))]


def _registered(frames: Image, index: int) -> Registration | None:
    """Where a frame lies in the mean of the others; None where the scene has nothing to register by."""
    others = (frames.sum(0) - frames[index]) / (len(frames) - 1)
    try:
        return register(frames[index], others)
    except ValueError:
        return None


def _drift(shift: Image, registrations: list[Registration | None]) -> tuple[float, bool]:
    known = [found for found in registrations if found is not None]
    if len(known) < 2:
        return float("nan"), False
    seen = shift[np.isfinite(shift).all(1)]
    drift = float(np.linalg.norm(seen[:, None] - seen[None], axis=-1).max())
    error = max(found.error_px for found in known)
    return drift, drift > max(LEAST_DRIFT, 5 * error) and len(known) == len(registrations)


def _compared(frames: Image, shift: Image, trusted: Mask) -> tuple[list[tuple[Image, Mask]], Mask]:
    """The mean of the others, moved onto each frame, with what it covers; and where the scene changes between frames."""
    references = [_others_on(frames, shift, index) for index in range(len(frames))]
    covered = np.logical_and.reduce([mask for _, mask in references]) & trusted
    residual = np.stack(
        [_residual(frame, others, covered) for frame, (others, _) in zip(frames, references, strict=True)]
    )
    return references, restless(residual, frames.mean(axis=0), covered)


def _residual(frame: Image, others: Image, mask: Mask) -> Image:
    """A frame less the mean of the others at the frame's own dose."""
    first, second = (ndimage.gaussian_filter(image, 2.0)[mask] for image in (frame, others))
    slope = np.cov(first, second)[0, 1] / max(np.var(second), np.finfo(float).tiny)
    if np.std(second) < 0.1 * np.std((frame - others)[mask]):  # a flat scene has no slope
        slope = 1.0
    return np.asarray(frame - slope * others - (frame - slope * others)[mask].mean())


def _require_still(moving: Mask, trusted: Mask, name: str) -> None:
    share = float(moving.sum() / trusted.sum())
    if share > LARGEST_CHANGE:
        raise ValueError(
            f"{name}: the scene changes between frames at {share:.0%} of its pixels (blinking, moving or bleaching objects), "
            "so that its change passes for noise; give frames of a scene that stands still, or crop to a part that does"
        )


def _others_on(frames: Image, shift: Image, index: int) -> tuple[Image, Mask]:
    """Mean of the other frames, each moved onto frame `index`, and the pixels that all of them cover.

    The mean of the others lies at minus 1/(n − 1) of the frame's own displacement, so that the shift found against it is
    n/(n − 1) times the displacement from the mean of all.
    """
    if not shift.any():
        return (frames.sum(0) - frames[index]) / (len(frames) - 1), np.ones(frames[0].shape, bool)
    displacement = shift * (len(shift) - 1) / len(shift)
    total, covered = np.zeros(frames[0].shape), np.ones(frames[0].shape, bool)
    for other in set(range(len(frames))) - {index}:
        matrix = np.column_stack([np.eye(2), displacement[index] - displacement[other]])
        moved, inside = _still(matrix).warp(frames[other])
        total += moved
        covered &= inside
    return total / (len(frames) - 1), covered


def _pair(
    frame: Image, others: Image, mask: Mask, registration: Registration, counts: MaskCounts, number: int
) -> AlignedPair:
    try:
        scaling = fit_scaling(frame, others, mask)
    except ValueError:  # a flat scene has no slope; only its level can be matched
        difference = (frame - others)[mask]
        scaling = Scaling(1.0, float(difference.mean()), 0.0, float(difference.std() / np.sqrt(difference.size)))
    signal = scaling.slope * others + scaling.intercept
    total = fit_line(signal[mask], ((frame - signal) ** 2)[mask])
    own = VarianceLine(total.floor / number, total.rate / number)
    return AlignedPair(frame, others, signal, mask, registration, scaling, total, own, counts, frames=number)


def _still(matrix: NDArray[np.float64] | None = None) -> Registration:
    matrix = np.eye(2, 3) if matrix is None else matrix
    return Registration(matrix, "translation", "phase correlation", 0, 0, float("nan"), float("nan"), 0.0, False)
