"""Correction of violated assumptions: changed regions, a misfit of the signal, offsets of rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.detector.residual import residual_of
from calibration.detector.scene_fit import SceneFit, changed_places, fit_scene, refitted, without_places
from calibration.exposures.frames import Image
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import VarianceLine, fit_line
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import CLEAR, GAIN, SCENE
from noiseflow.described import described


@described(changed="of the pixels", rows="counts", columns="counts", join="counts", joined="of the pixels")
@dataclass(frozen=True)
class Repairs:
    """Violated assumptions that were modelled before the detector was measured.

    Attributes:
        changed: share of pixels in regions that changed between the exposures; they were excluded.
        scene: fit of each pair's signal to the scene before any correction.
        scene_after: the same after a kernel was fitted between the exposures; equal to `scene` if none was.
        refitted: whether a kernel was fitted for any pair.
        rows, columns: standard deviation of the offsets subtracted from rows or columns, counts; 0 if none were.
        join: brightness above which a second converter was used, counts; infinite if none. If few, these pixels are clipped.
        joined: share of pixels above `join`.
    """

    changed: float = 0.0
    scene: tuple[SceneFit, ...] = ()
    scene_after: tuple[SceneFit, ...] = ()
    refitted: bool = False
    rows: float = 0.0
    columns: float = 0.0
    join: float = np.inf
    joined: float = 0.0


def repaired(pairs: Sequence[AlignedPair]) -> tuple[list[AlignedPair], Repairs]:
    """Correct the pairs for violated assumptions.

    Args:
        pairs: from `align_pair` or `align_burst`, which already excludes changed regions of a burst.

    Returns:
        The corrected pairs, and the corrections.
    """
    single = [pair.frames == 1 for pair in pairs]
    offsets = [_without_offsets(pair) for pair in pairs]
    found = [pair for pair, _, _ in offsets]
    changed = [
        changed_places(pair) if one else np.zeros_like(pair.mask) for pair, one in zip(found, single, strict=True)
    ]
    share = float(np.mean([mask.sum() / pair.mask.sum() for mask, pair in zip(changed, found, strict=True)]))
    scene = tuple(fit_scene(pair) for pair in found)
    misfits = [one.clear and one.largest[1] > SCENE for one in scene]
    if 0 < share < 0.5:  # with half the frame or more, no part of the scene is static
        found = [without_places(pair, mask) for pair, mask in zip(found, changed, strict=True)]
        misfits = [one.clear and one.largest[1] > SCENE for one in map(fit_scene, found)]
    found = [refitted(pair) if bad and one else pair for pair, bad, one in zip(found, misfits, single, strict=True)]
    fitted = [pair for pair, _, _ in offsets]
    after = tuple(
        before if now is then else fit_scene(now) for before, now, then in zip(scene, found, fitted, strict=True)
    )
    rows, columns = (float(np.sqrt(np.mean([deviation[axis] ** 2 for _, *deviation in offsets]))) for axis in (0, 1))
    return found, Repairs(share, scene, after, any(misfits), rows, columns)


def _without_offsets(pair: AlignedPair) -> tuple[AlignedPair, float, float]:
    """Subtract row and column offsets; return the pair and the standard deviations of the offsets, counts; 0 if none."""
    deviations = []
    for axis in (1, 0):
        residual = residual_of(pair)
        deviation, error = _shared(residual.z, residual.mask, axis)
        if deviation**2 < max(CLEAR * error, GAIN / 2):  # they add their square to the variance
            deviations.append(0.0)
            continue
        number = np.maximum(residual.mask.sum(axis, keepdims=True), 1)
        mean = np.where(pair.mask, pair.short - pair.signal, 0.0).sum(axis, keepdims=True) / number
        short = pair.short - np.where(pair.mask, mean, 0.0)
        factor = 1 / (1 - 1 / float(np.median(number)))  # the mean removes part of the noise
        total = fit_line(pair.signal[pair.mask], factor * ((short - pair.signal) ** 2)[pair.mask])
        own = pair.signal_variance
        pair = replace(pair, short=short, total_variance=VarianceLine(total.floor, total.rate), signal_variance=own)
        deviations.append(deviation * float(np.median(residual.spread[residual.mask])))
    return pair, deviations[0], deviations[1]


def _shared(z: Image, mask: Mask, axis: int) -> tuple[float, float]:
    """Standard deviation of the offsets common to the pixels of a row, and the standard error of its square.

    It is the covariance of the means of even and odd runs of 16 pixels along the row; correlated neighbours hardly affect it.
    """
    run = np.indices(z.shape)[axis] // 16 % 2
    parts = [mask & (run == part) for part in (0, 1)]
    known = np.min([part.sum(axis) for part in parts], axis=0) > 8  # both halves of a row must have enough pixels
    number = int(known.sum())
    if number < 16:
        return 0.0, 1.0
    means = [np.where(part, z, 0.0).sum(axis)[known] / part.sum(axis)[known] for part in parts]
    first, second = (one - one.mean() for one in means)
    # slow changes belong to the scene, not to the rows
    smooth = np.convolve(np.mean(means, axis=0), np.ones(9) / 9, mode="same")
    first, second = first - (smooth - smooth.mean()), second - (smooth - smooth.mean())
    covariance = float(np.mean(first * second)) / (1 - 1 / 9)
    error = float(np.sqrt(np.mean(first**2) * np.mean(second**2) / number))
    noise = float(np.mean(mask)) and 2 / z.shape[axis]
    return float(np.sqrt(max(covariance, 0.0))), max(error * 0.5, noise / np.sqrt(number))
