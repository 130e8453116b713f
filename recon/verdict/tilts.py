"""Findings about the tilts: range, gaps, steps, duplicate images, images that do not match their angle."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from noiseflow.checks import NotTested
from noiseflow.statistics import neighbour_products
from recon.series.screening import Screening
from recon.series.tilt_series import TiltSeries
from recon.verdict.coarse import Coarse
from recon.verdict.residuals import neighbours
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_WEDGE, _GAP, _FEWEST = (
    90.0,
    15.0,
    20,
)  # degrees without data, above which most directions are not measured; gap, degrees; smallest number of tilts
_LEFT_OUT = 0.1  # of the tilts: too many for exceptions
_FOREIGN, _FOREIGN_SHARE = 0.3, 0.1  # share of a tilt's structure that the others predict; share of the tilts
_BLANK = 0.3  # of the structure of neighbouring tilts: an image with less is blank and cannot be predicted
_TWINS = 0.2  # of the structure: duplicates differ only by noise
_JUMP, _AROUND = 3.0, 9  # relative to the change between surrounding tilts, and their number; good series reach 0.9
_JUMP_SHARE = 0.1  # of the structure of the images; remaining misalignment of a low-noise needle gives 0.001
_RADIANS = 1.6
_DRIFT = 0.2  # relative beam drift: the fit follows it, but not exactly


def coverage(angles: Array) -> tuple[dict[str, Any], list[Finding]]:
    """Range, gaps and number of the tilts."""
    directions = np.unique(np.round(np.mod(angles, 180), 3))
    gaps = np.sort(np.diff(np.append(directions, directions[0] + 180)))[::-1]
    wedge, inner = float(gaps[0]), float(gaps[1]) if len(gaps) > 1 else 0.0
    steps = np.diff(directions)
    evidence = {
        "tilts": len(angles),
        "degrees without data": wedge,
        "largest gap inside": inner,
        "median step": float(np.median(steps)),
        "in order": bool((np.diff(angles) > 0).all() or (np.diff(angles) < 0).all()),
    }
    findings = []
    if np.abs(angles).max() < _RADIANS:
        words = f"all tilt angles lie within ±{np.abs(angles).max():.2f}°, as if they were radians"
        findings.append(Finding("angles", 10.0, words, "give the tilt angles in degrees", "seen"))
    if wedge > _WEDGE:
        words = f"{wedge:.0f}° of 180° have no tilts, so most directions of the volume are not measured"
        findings.append(
            Finding("range", wedge / _WEDGE, words, "add tilts, or trust only structures that face the beam", "seen")
        )
    if inner > _GAP and len(directions) >= _FEWEST:
        words = f"the tilts leave a gap of {inner:.0f}° inside their range"
        findings.append(
            Finding(
                "range", min(2.9, inner / _GAP), words, "add tilts there, or expect streaks in these directions", "seen"
            )
        )
    if len(directions) < _FEWEST:
        words = f"{len(directions)} tilt angles are too few for fine detail"
        findings.append(Finding("range", min(2.9, _FEWEST / len(directions)), words, "take more tilts", "seen"))
    return evidence, findings


def repeats(tilt_series: TiltSeries) -> tuple[dict[str, Any], list[Finding]]:
    """Exactly equal images, which noise excludes for separate exposures."""
    groups: dict[bytes, int] = {}
    for image in tilt_series.images:
        key = np.ascontiguousarray(image).tobytes()
        groups[key] = groups.get(key, 0) + 1
    repeated = sum(count - 1 for count in groups.values())
    if repeated == 0:
        return {"repeated images": 0}, []
    share = repeated / tilt_series.num_tilts
    words = f"{repeated} of {tilt_series.num_tilts} images are exact copies of another image"
    finding = Finding("repeats", min(2.9, 1 + 3 * share), words, "remove the copies", "seen")
    return {"repeated images": repeated}, [finding]


def twins(coarse: Coarse) -> tuple[dict[str, Any], list[Finding]]:
    """Images at the same angle must differ only by noise, which is independent between neighbouring rows."""
    close = np.diff(np.sort(coarse.directions.angles)) < 0.02
    if not close.any() or coarse.images.shape[1] < 2:
        return {}, []
    difference = np.diff(coarse.arranged(), axis=0)[close]
    share = neighbours(difference, 1) / 2 / max(neighbours(coarse.centred_on_all, 1), 1e-30)
    evidence = {"twins differ by": share}
    if share < _TWINS:
        return evidence, []
    words = f"images of the same angle differ by {share:.0%} of their structure"
    return evidence, [
        Finding("angles", min(6.0, 3 * share / _TWINS), words, "check the list of tilt angles and its signs", "seen")
    ]


def jumps(coarse: Coarse) -> tuple[dict[str, Any], list[Finding]]:
    """Neighbouring tilts that differ much more than those around them, although a rotating object changes smoothly.

    The structure common to neighbouring rows of the difference is free of noise; it grows with the square of the step.
    """
    images, angles = coarse.arranged(), np.sort(coarse.directions.angles)
    apart = np.diff(angles) > 0.02
    if apart.sum() < _AROUND or images.shape[1] < 2:
        raise NotTested(f"needs two rows and {_AROUND + 1} tilts")
    differences, steps = np.diff(images, axis=0)[apart], np.diff(angles)[apart]
    shared = np.array([neighbours(each[None], 1) for each in differences]) / steps**2
    chance = (differences**2).mean((1, 2)) / np.sqrt(images[0].size) / steps**2
    usual = np.maximum(ndimage.median_filter(shared, _AROUND, mode="nearest"), chance)
    whole = max(neighbours(coarse.centred_on_all, 1), 1e-30)
    large = shared * steps**2 > _JUMP_SHARE * whole
    ratios = np.divide(shared - 3 * chance, usual, out=np.zeros_like(usual), where=large)  # exact copies give usual = 0
    largest = int(np.argmax(ratios))
    evidence = {"largest jump": float(ratios[largest])}
    if ratios[largest] < _JUMP:
        return evidence, []
    first, second = np.flatnonzero(apart)[largest] + (0, 1)
    words = (
        f"between {angles[first]:g}° and {angles[second]:g}° the images change {ratios[largest]:.0f} times as much as between "
        "the tilts around: angles are in the wrong order there, or the specimen moved"
    )
    strength = min(2.9, ratios[largest] / _JUMP)
    return evidence, [Finding("angles", strength, words, "check the list of angles and the images of these tilts")]


def foreign(coarse: Coarse, errors: Array) -> tuple[dict[str, Any], list[Finding]]:
    """Tilts that the others predict much worse than the rest, by the structure common to predicted and measured rows."""
    if coarse.images.shape[1] < 2:
        raise NotTested("needs two rows")
    measured, predicted = coarse.flat, coarse.centred(coarse.images - errors)
    agreement = neighbour_products(predicted, measured, axis=1).mean((1, 2))
    chance = np.sqrt((predicted**2).mean((1, 2)) * (measured**2).mean((1, 2)) / measured[0].size)
    own = neighbour_products(measured, axis=1).mean((1, 2))
    order = coarse.directions.order
    beside = np.empty_like(own)
    beside[order] = ndimage.maximum_filter1d(own[order], 3, mode="nearest")
    blank = own + (measured**2).mean((1, 2)) / np.sqrt(measured[0].size) < _BLANK * beside
    foreign = (agreement + 3 * chance < _FOREIGN * own) | blank
    share = float(foreign.mean())
    evidence = {"tilts unlike the others": int(foreign.sum())}
    if share <= _FOREIGN_SHARE:
        return evidence, []
    named = ", ".join(f"{angle:g}°" for angle in coarse.tilt_angles[foreign][:5])
    words = f"{int(foreign.sum())} of {len(foreign)} tilts hardly resemble the prediction from the others ({named} …)"
    advice = "check these images and their angles, or exclude them"
    return evidence, [Finding("tilts", min(4.0, 1 + share / _LEFT_OUT), words, advice)]


def screened(screening: Screening | None) -> tuple[dict[str, Any], list[Finding]]:
    """How many tilts were excluded, and how much the beam drifts."""
    if screening is None:
        return {}, []
    share, drift = float(screening.bad.mean()), screening.drift
    evidence = {"tilts thrown out": int(screening.bad.sum()), "beam drift": drift}
    findings = []
    if share > _LEFT_OUT:
        words = (
            f"{int(screening.bad.sum())} of {len(screening.bad)} tilts were excluded because they do not fit the others"
        )
        findings.append(
            Finding(
                "tilts",
                min(3.5, 1 + (share - _LEFT_OUT) / _LEFT_OUT),
                words,
                "align the series, or check the list of angles",
            )
        )
    if drift > _DRIFT:
        words = f"the beam changes by {drift:.0%} from tilt to tilt"
        findings.append(Finding("beam", min(2.9, drift / _DRIFT), words, "normalise the images by their incident beam"))
    return evidence, findings
