"""The verdict on a reconstruction, from its tilt series, its volume and the predicted images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.series.alignment import Alignment
from recon.series.contrast import explained, invert_contrast
from recon.series.first_guess import contrast_slab
from recon.series.screening import Screening
from recon.series.tilt_series import TiltSeries, VolumeGrid, block_means, evenly
from recon.verdict.coarse import Coarse, coarse_series, line_integrals
from recon.verdict.distortions import distortions
from recon.verdict.expected import expected_images
from recon.verdict.fits import fit_findings
from recon.verdict.gap_fit import Unexplained, unexplained
from recon.verdict.geometry import Geometry
from recon.verdict.geometry_findings import geometry_findings
from recon.verdict.image_findings import image_findings
from recon.verdict.pixels import pixel_findings
from recon.verdict.residuals import Residuals
from recon.verdict.sharpness import sharpness_findings
from recon.verdict.tilts import tilt_findings
from recon.verdict.verdict import Finding, Result, Verdict, verdict_of

Array = NDArray[Any]
_TALL = 4  # widths: only this number of slices of a taller series is used, because all may not fit into memory
_FULL = 1.3  # times the mean: sections that fill their volume reach 0.85, truncated objects 1.66 and more
_CONTRAST = 0.05  # correct and inverted phantoms differ by at least 0.12


def judge(
    tilt_series: TiltSeries,
    result: Result,
    *,
    screening: Screening | None = None,
    alignment: Alignment | None = None,
) -> Verdict:
    """Assess a volume by the residuals of its projections, and by held-out contiguous gaps of tilts.

    Args:
        tilt_series: the reconstructed series, aligned and without rejected tilts.
        result: volume, projections (tilt, y, u) in detector units, and noise model and fit history if available.
        screening: screening of all tilts.
        alignment: alignment of the raw images, if they were aligned.

    Raises:
        ValueError: projections and images differ in shape.
    """
    if result.projections.shape != tilt_series.images.shape:
        raise ValueError(
            f"projections {result.projections.shape} do not match images {tilt_series.images.shape}; give the tilt series "
            "that the volume was made from"
        )
    shape = np.shape(result.volume.attenuation)
    rows = contrast_slab(tilt_series, _TALL * tilt_series.images.shape[2])
    grid = VolumeGrid(shape[0], rows.stop - rows.start, shape[2])
    tilt_series, expected = tilt_series.rows(rows), expected_images(result, rows)
    residuals = Residuals.of(tilt_series, expected)
    coarse = coarse_series(tilt_series, grid)
    geometry = Geometry(coarse)
    gap, own = _gaps(tilt_series, expected, coarse, geometry)
    found = distortions(residuals)
    parts = [
        geometry_findings(geometry, gap, own, found),
        image_findings(residuals, found),
        tilt_findings(tilt_series, coarse, geometry, screening),
        pixel_findings(tilt_series, residuals),
        sharpness_findings(tilt_series, residuals),
        fit_findings(result, alignment),
        _contrast(tilt_series),
        _faces(result.volume.attenuation),
    ]
    evidence: dict[str, Any] = {}
    findings: list[Finding] = []
    for part, finding in parts:
        evidence |= part
        findings += finding
    return verdict_of(findings, evidence, good=_good(gap, residuals))


def _gaps(
    tilt_series: TiltSeries, expected: Array, coarse: Coarse, geometry: Geometry
) -> tuple[Unexplained, Unexplained]:
    """Unexplained structure of held-out gaps, for the images and for the projections of the volume, which are consistent."""
    some = tilt_series.select(coarse.tilts)
    own = line_integrals(some, expected[evenly(coarse.tilts, len(expected))], coarse.binning)
    return unexplained(coarse.images, geometry.errors), unexplained(own, geometry.fit.errors(own))


def _contrast(tilt_series: TiltSeries) -> tuple[dict[str, Any], list[Finding]]:
    """Whether a coarse non-negative volume explains the images better with inverted contrast."""
    height, width = tilt_series.images.shape[1:]
    small = replace(tilt_series, images=block_means(tilt_series.images, -(-height // 16), -(-width // 32)), mask=None)
    as_given, swapped = explained(small), explained(invert_contrast(small))
    evidence = {"contrast": {"as given": as_given, "swapped": swapped}}
    if swapped < as_given + _CONTRAST:
        return evidence, []
    other = "--mode transmission" if tilt_series.mode == "linear" else "--mode linear"
    words = (
        f"the contrast looks inverted: a volume explains {max(as_given, 0):.0%} of the images, and {swapped:.0%} with inverted "
        "contrast"
    )
    return evidence, [
        Finding("mode", 3.0 + (swapped - as_given) / _CONTRAST, words, f"give {other}, or --invert-contrast")
    ]


def _faces(volume: Array) -> tuple[dict[str, Any], list[Finding]]:
    """Whether material beyond the top or bottom of a thin volume was projected into its outer layers."""
    depth, height, width = volume.shape
    if depth >= width:
        return {}, []
    layers = np.abs(volume[:, :: max(1, height // 64)]).mean((1, 2), dtype=np.float64)
    densest = float(max(layers[0], layers[-1]) / max(float(layers.mean()), 1e-30))
    if densest < _FULL:
        return {"densest face": densest}, []
    words = (
        f"the volume is {densest:.1f} times as dense at its top or bottom as on average: the object extends beyond it"
    )
    advice = "remove --thickness, or give a larger value"
    return {"densest face": densest}, [Finding("thickness", min(2.9, densest / _FULL), words, advice, "seen")]


def _good(gap: Unexplained, residuals: Residuals) -> str:
    white = max(abs(value) for value in residuals.whiteness().values())
    return (
        f"the volume explains {min(1.0, 1 - gap.share):.1%} of the structure of held-out gaps of tilts, and neighbouring "
        f"residuals correlate by at most {white:.2f}; images do not determine the sign and the zero of the tilt angles"
    )
