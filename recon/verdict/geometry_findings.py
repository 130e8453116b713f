"""Findings about axis, angles, thickness and specimen from held-out gaps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from recon.verdict.gap_fit import Unexplained
from recon.verdict.geometry import Gain, Geometry
from recon.verdict.residuals import neighbours
from recon.verdict.verdict import Finding

# smallest relevant gain, share of the error of held-out tilts: 60 independent good series gain at most 0.05
_GAIN = 0.06
# the same for other angles, because smaller ones make any object smoother: 60 independent good series gain at most 0.1
_ANGLES = 0.1
# standard errors over the gaps, of which there may be few
_SCORE = 2.5
# views: fewer leave too few gaps for a standard error
_VIEWS = 20
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
    few = len(np.unique(np.round(geometry.coarse.directions.angles, 3))) < _VIEWS
    gains = [] if few else list(_gains(geometry))
    edge, structure = _edge(geometry), _structure(geometry)
    evidence = {
        "gap": {"unexplained": gap.share, "error": gap.error, "expected": expected.share},
        "structure over chance": structure,
        **{name: _as_dict(gain) for name, gain, _ in gains},
        "signal at the sides": edge,
    }
    if structure < _STRUCTURE:
        words = "neighbouring pixels of the images are not correlated: no object is visible"
        return evidence, [Finding("noise", 10.0, words, "use a longer exposure, or check the file")]
    findings = [finding for *_, finding in gains]
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


def _gains(geometry: Geometry) -> Iterator[tuple[str, Gain, Finding]]:
    """Yield the name, the gain, and the finding, of every other geometry."""
    axis, angles, objects, thicker = (
        geometry.axis(),
        geometry.angles(),
        geometry.two_objects(),
        geometry.thicker(),
    )

    def finding(subject: str, gain: Gain, limit: float, words: str, advice: str) -> Finding:
        fires = gain.share >= limit and gain.score >= _SCORE
        words = f"{words}: the error of held-out tilts decreases by {gain.share:.0%}"
        return Finding(subject, min(6.0, 1 + gain.share / limit) if fires else 0.0, words, advice)

    words, advice = f"images {axis.what} explain each other better", "give --tilt-axis, or use --refine-alignment"
    yield "other axis", axis, finding("axis", axis, _GAIN, words, advice)
    words, advice = f"tilt angles {angles.what} explain held-out tilts better", "check the list of tilt angles"
    yield "other angles", angles, finding("angles", angles, _ANGLES, words, advice)
    words = f"two parts of the series contradict each other ({objects.what})"
    advice = "reconstruct the parts separately; the specimen moved or changed between them"
    yield "two objects", objects, finding("specimen", objects, _GAIN, words, advice)
    words, advice = f"the volume is too thin for one {thicker.what}", "remove --thickness, or give a larger value"
    yield "thicker", thicker, finding("thickness", thicker, _GAIN, words, advice)


def _edge(geometry: Geometry) -> float:
    """Mean line integral of the outer columns relative to that of all columns, both above the emptiest column."""
    coarse = geometry.coarse
    profile = (coarse.images * coarse.used).sum((0, 1)) / np.maximum(coarse.used.sum((0, 1)), 1)
    profile = profile[coarse.used.any((0, 1))]
    raised = profile - profile.min()
    return float(max(raised[0], raised[-1]) / max(raised.mean(), 1e-30))


def _structure(geometry: Geometry) -> float:
    """Structure common to neighbouring pixels, in standard errors: the larger value of y and u."""
    flat = geometry.coarse.flat
    chance = max(float(np.mean(flat**2)) / float(np.sqrt(flat.size)), 1e-30)
    return max(neighbours(flat, axis) for axis in (1, 2)) / chance


def _as_dict(gain: Gain) -> dict[str, Any]:
    return {"what": gain.what, "share": gain.share, "score": gain.score}
