"""Correction of violated assumptions: changed regions, a misfit of the signal, offsets of rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.detector.residual import residual_of, without_bands
from calibration.detector.scene_fit import SceneFit, changed_places, fit_scene, refitted, without_places
from calibration.exposures.scaling import VarianceLine, fit_line
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import SCENE
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
    for axis in (2, 1):
        residual, own = residual_of(pair), pair.signal_variance
        difference, deviation = without_bands(
            (pair.short - pair.signal)[None], residual.z[None], pair.mask, axis=axis, scene=True
        )
        deviations.append(deviation * float(np.median(residual.spread[residual.mask])))
        if deviation:
            total = fit_line(pair.signal[pair.mask], (difference[0] ** 2)[pair.mask])
            total = VarianceLine(total.floor, total.rate)
            pair = replace(pair, short=pair.signal + difference[0], total_variance=total, signal_variance=own)
    return pair, deviations[0], deviations[1]
