"""Continuity of the images: single inconsistent tilts, and breaks of the series."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from noiseflow.checks import NotTested
from noiseflow.statistics import neighbour_products, robust_deviation
from recon.verdict.coarse import Coarse
from recon.verdict.residuals import neighbours
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_LONE, _LONE_SHARE, _BESIDE = (
    6.0,
    0.3,
    11,
)  # typical deviations, good series up to 4.1; share of the structure; number of neighbouring tilts
_BREAK, _BREAK_SCORE, _AROUND = (
    0.5,
    4.0,
    9,
)  # of what neighbours share elsewhere, good series 0.58; standard errors; pairs
_WIDE = 1.5  # median steps: images further apart need not be similar


def single_tilts(coarse: Coarse, errors: Array) -> tuple[dict[str, Any], list[Finding]]:
    """Single tilts that are predicted far worse than neighbouring tilts; tilts at the ends have few neighbours."""
    images, left = coarse.directions.arranged(coarse.flat), coarse.arranged(errors)
    if images.shape[1] < 2 or len(images) < 2 * _BESIDE:
        raise NotTested(f"needs two rows and {2 * _BESIDE} tilts")
    structure = float(np.median([neighbours(image[None], 1) for image in images]))
    shared = np.array([neighbours(each[None], 1) for each in left])
    beyond = shared - ndimage.median_filter(shared, _BESIDE, mode="nearest")
    usual = robust_deviation(beyond, 0.0)
    far = (beyond > _LONE * usual) & (beyond > _LONE_SHARE * structure)
    far[:2] = far[-2:] = False
    evidence = {"lone tilts": int(far.sum())}
    if not far.any():
        return evidence, []
    named = ", ".join(f"{angle:g}°" for angle in coarse.tilt_angles[coarse.directions.order][far][:5])
    words = f"the image at {named} is inconsistent with its neighbours: it belongs to another tilt or another object"
    strength = float(min(2.9, (beyond / max(usual, 1e-30))[far].max() / _LONE))
    return evidence, [Finding("tilts", strength, words, "check its angle, or exclude it")]


def breaks(coarse: Coarse) -> tuple[dict[str, Any], list[Finding]]:
    """A single break: neighbouring images with much less common structure than all other neighbours."""
    flat, angles = coarse.directions.arranged(coarse.flat), np.sort(coarse.directions.angles)
    steps = np.diff(angles)
    if len(flat) < 2 * _AROUND:
        raise NotTested(f"needs {2 * _AROUND} tilts")
    power = (flat**2).mean((1, 2))
    shared = neighbour_products(flat, axis=0).mean((1, 2))
    chance = np.sqrt(neighbour_products(power) / flat[0].size)
    usual = ndimage.median_filter(shared, _AROUND, mode="nearest")
    apart = (shared < _BREAK * usual) & (usual - shared > _BREAK_SCORE * chance) & (steps < _WIDE * np.median(steps))
    evidence = {"breaks": int(apart.sum())}
    if apart.sum() != 1:  # several breaks mean wrong angles, which other evidence detects
        return evidence, []
    where = int(np.argmax(apart))
    between = f"up to {angles[where]:g}° and from {angles[where + 1]:g}° on"
    words = f"the images {between} do not match at the border: the specimen changed"
    advice = "reconstruct both parts separately, or check whether one of them was flipped"
    return evidence, [Finding("specimen", 2.9, words, advice, "seen")]
