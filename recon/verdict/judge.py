"""The verdict on a reconstruction, from its tilt series, its volume and the predicted images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Guard
from recon.series.alignment import Alignment
from recon.series.contrast import explained, invert_contrast
from recon.series.dual_axis import about, own_images
from recon.series.first_guess import contrast_slab
from recon.series.masks import coarse
from recon.series.screening import Screening
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid, evenly
from recon.verdict import continuity, fits, pixels, tilts
from recon.verdict.coarse import Coarse, coarse_series, line_integrals
from recon.verdict.distortions import Distortion, distortions
from recon.verdict.expected import expected_images
from recon.verdict.gap_fit import Unexplained, unexplained
from recon.verdict.geometry import Geometry
from recon.verdict.geometry_findings import geometry_findings
from recon.verdict.image_findings import image_findings
from recon.verdict.limits import cliff, saturation
from recon.verdict.residuals import Residuals
from recon.verdict.sharpness import sharpness_findings
from recon.verdict.size_findings import size_findings
from recon.verdict.verdict import Finding, Result, Verdict, verdict_of

Array = NDArray[Any]
_TALL = 4  # widths: only this number of slices of a taller series is used, because all may not fit into memory
_FULL = 1.3  # times the mean: sections that fill their volume reach 0.85, truncated objects 1.66 and more
_CONTRAST = 0.05  # correct and inverted phantoms differ by at least 0.12
_NOTHING = "no check that could be applied found a fault"


Part = tuple[dict[str, Any], list[Finding]]


@dataclass(frozen=True)
class Case:
    """A reconstruction to assess; what several checks need is computed once, by the first that needs it.

    Attributes:
        tilt_series: the reconstructed series.
        result: volume and projections (tilt, y, u), detector units.
        screening: screening of all tilts, if done.
        alignment: alignment of the raw images, if done.
    """

    tilt_series: TiltSeries
    result: Result
    screening: Screening | None = None
    alignment: Alignment | None = None

    @cached_property
    def rows(self) -> slice:
        """The slices that are used, because those of a tall series may not fit into memory."""
        return contrast_slab(self.tilt_series, _TALL * self.tilt_series.images.shape[2])

    @cached_property
    def series(self) -> TiltSeries:
        """The series in these slices."""
        return self.tilt_series.rows(self.rows)

    @cached_property
    def expected(self) -> Array:
        """(tilt, y, u) expected images of the volume in these slices, detector units."""
        return expected_images(self.result, self.rows)

    @cached_property
    def residuals(self) -> Residuals:
        """Images minus their expectation."""
        return Residuals.of(self.series, self.expected)

    @cached_property
    def distortions(self) -> dict[str, Distortion]:
        """Distortions of the images relative to the volume."""
        return distortions(self.residuals)

    @cached_property
    def coarse(self) -> Coarse:
        """Coarse line integrals."""
        depth, _, width = np.shape(self.result.volume.attenuation)
        return coarse_series(self.series, VolumeGrid(depth, self.rows.stop - self.rows.start, width))

    @cached_property
    def geometry(self) -> Geometry:
        """Predictions of held-out gaps of tilts."""
        return Geometry(self.coarse)

    def _integrals(self, images: Array) -> tuple[Array, Array]:
        """Coarse line integrals and mask of any images of the series."""
        tilts = evenly(self.coarse.tilts, len(images))
        return line_integrals(self.series.select(self.coarse.tilts), images[tilts], self.coarse.binning)

    @cached_property
    def gap(self) -> Unexplained:
        """Unexplained structure of held-out gaps."""
        return unexplained(self.coarse.centred_on_all, self.geometry.errors)

    @cached_property
    def own_gap(self) -> Unexplained:
        """The same for the projections of the volume, which are consistent with each other."""
        own, used = self._integrals(self.expected)
        return unexplained((own - own[used].mean()) * used, self.geometry.fit.errors(own, used))


def _of_pixels(check: Callable[[TiltSeries, Array, Residuals], Part]) -> Callable[[Case], Part]:
    return lambda case: check(case.series, case.residuals.images, case.residuals)


def _contrast(case: Case) -> Part:
    """Whether a coarse non-negative volume explains the images better with inverted contrast."""
    tilt_series = case.series
    small = coarse(tilt_series, height=16, width=32)
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


def _faces(case: Case) -> Part:
    """Whether material beyond the top or bottom of a thin volume was projected into its outer layers."""
    volume = case.result.volume.attenuation
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


PIXELS: dict[str, Callable[[TiltSeries, Array, Residuals], Part]] = {
    "saturation": saturation,
    "end of the pixel values": cliff,
    "spikes": pixels.spikes,
    "dead lines": pixels.lines,
    "dead pixels": pixels.region,
    "streaks": pixels.streaks,
    "filled borders": pixels.borders,
    "steps between columns": pixels.seam,
    "compression": pixels.blocks,
    "fixed pattern": pixels.pattern,
    "uneven response": pixels.uneven,
}
"""Checks of pixel values by name."""

CHECKS: dict[str, Callable[[Case], Part]] = {
    "held-out gaps of tilts": lambda case: geometry_findings(case.geometry, case.gap, case.own_gap),
    "residuals and distortions": lambda case: image_findings(case.residuals, case.distortions),
    "tilt range": lambda case: tilts.coverage(case.series.tilt_angles),
    "repeated images": lambda case: tilts.repeats(case.series),
    "images of one angle": lambda case: tilts.twins(case.coarse),
    "changes between tilts": lambda case: tilts.jumps(case.coarse),
    "tilts unlike the others": lambda case: tilts.foreign(case.coarse, case.geometry.errors),
    "single tilts": lambda case: continuity.single_tilts(case.coarse, case.geometry.single_errors()),
    "breaks": lambda case: continuity.breaks(case.coarse),
    "size of the specimen": lambda case: size_findings(case.series),
    "excluded tilts": lambda case: tilts.screened(case.screening),
    **{name: _of_pixels(check) for name, check in PIXELS.items()},
    "sharpness": lambda case: sharpness_findings(case.series, case.residuals),
    "convergence": lambda case: fits.convergence(getattr(case.result, "fit_result", None)),
    "weight": lambda case: fits.weight(getattr(case.result, "weights_tried", None) or {}),
    "tilt axis": lambda case: fits.axis(case.alignment),
    "contrast": _contrast,
    "faces of the volume": _faces,
}
"""The checks by name."""


def judge(
    tilt_series: TiltSeries,
    result: Result,
    *,
    screening: Screening | None = None,
    alignment: Alignment | None = None,
    guard: Guard | None = None,
) -> Verdict:
    """Assess a volume by the residuals of its projections, and by held-out contiguous gaps of tilts.

    A check that fails or cannot be applied is listed in `Verdict.not_tested`; it does not stop the others.

    Args:
        tilt_series: the reconstructed series, aligned and without rejected tilts.
        result: volume, projections (tilt, y, u) in detector units, and noise model and fit history if available.
        screening: screening of all tilts.
        alignment: alignment of the raw images, if they were aligned.
        guard: checks before this one that were not tested, such as `Prepared.guard`.

    Raises:
        ValueError: projections and images differ in shape.
    """
    if result.projections.shape != tilt_series.images.shape:
        raise ValueError(
            f"projections {result.projections.shape} do not match images {tilt_series.images.shape}; give the tilt series "
            "that the volume was made from"
        )
    case, guard = Case(tilt_series, result, screening, alignment), Guard() if guard is None else guard
    if tilt_series.axes is not None:
        return _of_both_axes(case, guard)
    evidence: dict[str, Any] = {}
    findings: list[Finding] = []
    for name, check in CHECKS.items():
        nothing: Part = {}, []
        part, found = guard(name, partial(check, case), otherwise=nothing)
        evidence |= part
        findings += found
    return verdict_of(findings, evidence, good=guard("summary", lambda: _good(case), otherwise=_NOTHING), guard=guard)


def _of_both_axes(case: Case, guard: Guard) -> Verdict:
    """The verdicts of both axes as one; each judges the tilts about it with the geometry of one axis."""
    result, verdicts = case.result, list[Verdict]()
    assert case.tilt_series.axes is not None
    for second in (False, True):
        images, volume = result.projections[(case.tilt_series.axes != 0) == second], result.volume.attenuation
        if second:
            images, volume = own_images(images), own_images(volume)
        shown = _Shown(replace(result.volume, attenuation=volume), images, result.fit_result, result.noise_model)
        screening, alignment = (None, None) if second else (case.screening, case.alignment)
        verdicts.append(judge(about(case.tilt_series, second=second), shown, screening=screening, alignment=alignment))
    evidence = dict(zip(("first axis", "second axis"), (verdict.evidence for verdict in verdicts), strict=True))
    findings = [
        replace(finding, sentence=f"{name}: {finding.sentence}")
        for name, verdict in zip(evidence, verdicts, strict=True)
        for finding in verdict.findings
    ]
    for name, verdict in zip(evidence, verdicts, strict=True):
        guard.not_tested.update({f"{name}: {check}": why for check, why in verdict.not_tested.items()})
    good = "; ".join(f"{name}: {verdict.reasons[0]}" for name, verdict in zip(evidence, verdicts, strict=True))
    return verdict_of(findings, evidence, good=good, guard=guard)


@dataclass(frozen=True)
class _Shown:
    """The part of a result about one axis."""

    volume: Volume
    projections: Array
    fit_result: Any
    noise_model: Any


def _good(case: Case) -> str:
    white = max(abs(value) for value in case.residuals.whiteness().values())
    return (
        f"the volume explains {min(1.0, 1 - case.gap.share):.1%} of the structure of held-out gaps of tilts, and neighbouring "
        f"residuals correlate by at most {white:.2f}; images do not determine the sign and the zero of the tilt angles"
    )
