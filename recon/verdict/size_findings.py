"""Findings about a specimen that shrinks with the dose."""

from __future__ import annotations

from typing import Any

from noiseflow.checks import NotTested
from recon.series.shrinkage import FEWEST_TILTS, estimate_shrinkage
from recon.series.tilt_series import TiltSeries
from recon.verdict.verdict import Finding

_TOLERATED = 0.03  # of the size: moves the edge of a specimen of 48 pixels by a third of a pixel
_MOST = 2.9  # strength: the shape is right, and edges are blurred


def size_findings(tilt_series: TiltSeries) -> tuple[dict[str, Any], list[Finding]]:
    """Whether the specimen changes its size smoothly with the dose, see `recon.series.shrinkage`.

    Raises:
        NotTested: there are too few tilts, or no profile along the axis.
    """
    if tilt_series.num_tilts < FEWEST_TILTS:
        raise NotTested(f"{tilt_series.num_tilts} tilts are too few to measure a change of size")
    found = estimate_shrinkage(tilt_series)
    evidence = {"change of size": found.as_dict()}
    if not found.found:
        return evidence, []
    words = f"the specimen changes its size by {found.change:+.1%} ± {found.error:.1%} over the series ({found.order} order)"
    advice = "give --refine-alignment, which corrects it, or use the tilts that were taken first"
    return evidence, [Finding("specimen", min(_MOST, abs(found.change) / _TOLERATED), words, advice)]
