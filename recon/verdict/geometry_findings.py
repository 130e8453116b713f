"""Findings about axis, angles, thickness and specimen from held-out gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.verdict.gap_fit import Unexplained
from recon.verdict.geometry import Gain, Geometry
from recon.verdict.residuals import neighbours
from recon.verdict.verdict import Finding

_AXIS, _AXIS_SCORE = 0.02, 1.8  # of the error of held-out tilts; standard scenes gain at most 0.006
_ANGLES, _ANGLES_SCORE = 0.055, 3.0  # smaller angles make any object smoother; standard scenes gain up to 0.04
_OBJECTS, _OBJECTS_SCORE = 0.06, 1.0  # halves have less data; for one object they lose 0.07 to 0.13
_THICKER, _THICKER_SCORE = 0.05, 2.0
_SLACK, _TIMES = 0.06, 3.0  # share of the structure; factor relative to the volume's own projections
_EDGE = 0.4  # line integral at the sides relative to the mean: above it, the object extends beyond the sides
_STRUCTURE = 8.0  # standard errors of the structure common to neighbouring rows
_BLUNT = 0.1  # uncertainty of the share of the structure: above it, the following tests cannot detect defects


def geometry_findings(
    geometry: Geometry, gap: Unexplained, expected: Unexplained
) -> tuple[dict[str, Any], list[Finding]]:
    """Evidence and findings of the coarse series."""
    tolerable = _TIMES * max(expected.share, 0.0) + _SLACK
    beyond = float((gap.share - 2 * gap.error) / tolerable)
    axis, objects = geometry.axis(), geometry.two_objects()
    angles, thicker = geometry.angles(), geometry.thicker()
    edge, structure = _edge(geometry), _structure(geometry)
    evidence = {
        "gap": {"unexplained": gap.share, "error": gap.error, "expected": expected.share},
        "structure over chance": structure,
        "other axis": _as_dict(axis),
        "other angles": _as_dict(angles),
        "two objects": _as_dict(objects),
        "thicker": _as_dict(thicker),
        "signal at the sides": edge,
    }
    if structure < _STRUCTURE:
        words = "neighbouring pixels of the images are not correlated: no object is visible"
        return evidence, [Finding("noise", 10.0, words, "use a longer exposure, or check the file")]
    findings = [*_axis(axis), *_angles(angles), *_objects(objects), *_thicker(thicker)]
    if edge > _EDGE and beyond > 0.5:
        words = f"the object extends beyond the sides of the images, with {edge:.0%} of the mean signal there"
        findings.append(
            Finding("field", min(3.5, max(1.0, 2 * beyond)), words, "use a larger field of view, or a smaller object")
        )
    if beyond >= 1:
        words = (
            f"{gap.share:.0%} of the structure of held-out gaps of tilts is not explained by the others; a correct volume "
            f"would leave {expected.share:.0%} unexplained"
        )
        findings.append(
            Finding("consistency", min(beyond, 3.5), words, "check axis, shifts and angles of the series", "general")
        )
    if gap.error > _BLUNT:
        words = f"noise limits the test: the explained share of held-out tilts has an error of ±{gap.error:.0%}"
        findings.append(
            Finding("noise", min(2.9, gap.error / _BLUNT), words, "average exposures, or bin the images", "general")
        )
    return evidence, findings


def _axis(gain: Gain) -> list[Finding]:
    if gain.share < _AXIS or gain.score < _AXIS_SCORE:
        return []
    words = f"images {gain.what} explain each other better: the error of held-out tilts decreases by {gain.share:.0%}"
    return [Finding("axis", min(6.0, 1 + gain.share / _AXIS), words, "give --tilt-axis, or use --refine-alignment")]


def _angles(gain: Gain) -> list[Finding]:
    if gain.share < _ANGLES or gain.score < _ANGLES_SCORE:
        return []
    words = f"tilt angles {gain.what} explain held-out tilts better: their error decreases by {gain.share:.0%}"
    return [Finding("angles", min(6.0, 1 + gain.share / _ANGLES), words, "check the list of tilt angles")]


def _objects(gain: Gain) -> list[Finding]:
    if gain.share < _OBJECTS or gain.score < _OBJECTS_SCORE:
        return []
    words = f"two parts of the series contradict each other ({gain.what}): each alone is explained better, by {gain.share:.0%}"
    return [
        Finding(
            "specimen",
            min(6.0, 1 + gain.share / _OBJECTS),
            words,
            "reconstruct the parts separately; the specimen moved or changed between them",
        )
    ]


def _thicker(gain: Gain) -> list[Finding]:
    if gain.share < _THICKER or gain.score < _THICKER_SCORE:
        return []
    words = f"the volume is too thin: one {gain.what} explains held-out tilts better by {gain.share:.0%}"
    return [
        Finding("thickness", min(6.0, 1 + gain.share / _THICKER), words, "remove --thickness, or give a larger value")
    ]


def _edge(geometry: Geometry) -> float:
    """Mean line integral of the outer columns relative to that of all columns, both above the emptiest column."""
    profile = geometry.coarse.images.mean((0, 1))
    raised = profile - profile.min()
    return float(max(raised[0], raised[-1]) / max(raised.mean(), 1e-30))


def _structure(geometry: Geometry) -> float:
    """Structure common to neighbouring pixels, in standard errors: the larger value of y and u."""
    images = geometry.coarse.images
    flat = images - images.mean((1, 2), keepdims=True)
    chance = max(float(np.mean(flat**2)) / float(np.sqrt(flat.size)), 1e-30)
    return max(neighbours(flat, axis) for axis in (1, 2)) / chance


def _as_dict(gain: Gain) -> dict[str, Any]:
    return {"what": gain.what, "share": gain.share, "score": gain.score}
