"""What of a broken assumption can be modelled: places that changed, a signal that does not fit, offsets of rows and columns."""

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
from noiseflow.described import described

LEAST_SHARE = 0.003
"""Share of the residual's variance below which what follows the scene moves the gain by less than its 2 % goal: the share lies
where the scene is bright or steep, which multiplies it in the slope by a few."""

LEAST_OFFSETS = 0.1
"""Deviation of row offsets, in those of the noise, below which they change a variance by less than 1 %."""

CLEAR = 5.0
"""Standard errors beyond which row offsets are there."""


@described(changed="of the pixels", rows="counts", columns="counts", join="counts", joined="of the pixels")
@dataclass(frozen=True)
class Repairs:
    """What was found and modelled before the detector was measured.

    Attributes:
        changed: share of the pixels in places that changed between the exposures, which were left out.
        scene: how the signal of each pair fitted the scene, before.
        scene_after: the same after a kernel was fitted between the exposures; as `scene` where none was.
        refitted: whether any was.
        rows, columns: standard deviation of the offsets taken out of each row or column; 0: none was.
        join: brightness from which on a second converter read the pixels; infinite: none. A few are treated as clipped.
        joined: share of those pixels.
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
    """The pairs with what broke their assumptions modelled, and what that was.

    Args:
        pairs: from `align_pair` or `align_burst`; a burst loses changed places when it is aligned.
    """
    single = [pair.frames == 1 for pair in pairs]
    offsets = [_without_offsets(pair) for pair in pairs]
    found = [pair for pair, _, _ in offsets]
    changed = [
        changed_places(pair) if one else np.zeros_like(pair.mask) for pair, one in zip(found, single, strict=True)
    ]
    share = float(np.mean([mask.sum() / pair.mask.sum() for mask, pair in zip(changed, found, strict=True)]))
    scene = tuple(fit_scene(pair) for pair in found)
    misfits = [one.clear and one.largest[1] > LEAST_SHARE for one in scene]
    if 0 < share < 0.5:  # else the places are everywhere: no part of the scene stands still
        found = [without_places(pair, mask) for pair, mask in zip(found, changed, strict=True)]
        misfits = [one.clear and one.largest[1] > LEAST_SHARE for one in map(fit_scene, found)]
    found = [refitted(pair) if bad and one else pair for pair, bad, one in zip(found, misfits, single, strict=True)]
    fitted = [pair for pair, _, _ in offsets]
    after = tuple(
        before if now is then else fit_scene(now) for before, now, then in zip(scene, found, fitted, strict=True)
    )
    rows, columns = (float(np.sqrt(np.mean([deviation[axis] ** 2 for _, *deviation in offsets]))) for axis in (0, 1))
    return found, Repairs(share, scene, after, any(misfits), rows, columns)


def _without_offsets(pair: AlignedPair) -> tuple[AlignedPair, float, float]:
    """The pair without the offsets of its rows and of its columns, and their deviations, counts; 0 where there are none."""
    deviations = []
    for axis in (1, 0):
        residual = residual_of(pair)
        deviation, error = _shared(residual.z, residual.mask, axis)
        if deviation**2 < CLEAR * error or deviation < LEAST_OFFSETS:
            deviations.append(0.0)
            continue
        number = np.maximum(residual.mask.sum(axis, keepdims=True), 1)
        mean = np.where(pair.mask, pair.short - pair.signal, 0.0).sum(axis, keepdims=True) / number
        short = pair.short - np.where(pair.mask, mean, 0.0)
        factor = 1 / (1 - 1 / float(np.median(number)))  # what the mean takes of the noise with it
        total = fit_line(pair.signal[pair.mask], factor * ((short - pair.signal) ** 2)[pair.mask])
        own = pair.signal_variance
        pair = replace(pair, short=short, total_variance=VarianceLine(total.floor, total.rate), signal_variance=own)
        deviations.append(deviation * float(np.median(residual.spread[residual.mask])))
    return pair, deviations[0], deviations[1]


def _shared(z: Image, mask: Mask, axis: int) -> tuple[float, float]:
    """Deviation that all pixels of a row share, and the standard error of its square.

    The covariance of the means of even and odd runs of 16 pixels along the row, which correlated neighbours hardly touch.
    """
    run = np.indices(z.shape)[axis] // 16 % 2
    parts = [mask & (run == part) for part in (0, 1)]
    known = np.min([part.sum(axis) for part in parts], axis=0) > 8  # a row counts where both of its halves are known
    number = int(known.sum())
    if number < 16:
        return 0.0, 1.0
    means = [np.where(part, z, 0.0).sum(axis)[known] / part.sum(axis)[known] for part in parts]
    first, second = (one - one.mean() for one in means)
    smooth = np.convolve(
        np.mean(means, axis=0), np.ones(9) / 9, mode="same"
    )  # a slow change is of the scene, not of rows
    first, second = first - (smooth - smooth.mean()), second - (smooth - smooth.mean())
    covariance = float(np.mean(first * second)) / (1 - 1 / 9)
    error = float(np.sqrt(np.mean(first**2) * np.mean(second**2) / number))
    noise = float(np.mean(mask)) and 2 / z.shape[axis]
    return float(np.sqrt(max(covariance, 0.0))), max(error * 0.5, noise / np.sqrt(number))
