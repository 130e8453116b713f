"""The verdict on a reconstruction, from its tilt series, its volume and the predicted images."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Guard, Verdict, run, verdict_of
from recon.series.alignment import Alignment
from recon.series.orientation import about, own_images
from recon.series.screening import Screening
from recon.series.tilt_series import TiltSeries
from recon.verdict.case import Case
from recon.verdict.compared import Result
from recon.verdict.table import CHECKS


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
        return _of_both_axes(case, tilt_series.axes != 0, guard)
    found = run(CHECKS.values(), case, guard)
    good = guard(
        "summary",
        lambda: (
            f"the volume explains {min(1.0, 1 - case.gaps):.1%} of the structure of held-out gaps of tilts, and neighbouring "
            f"residuals share {case.residuals.shared():.1%} of the variance of the images; images do not determine the sign "
            "and the zero of the tilt angles"
        ),
        otherwise="no check that could be applied found a fault",
    )
    evidence = {name: finding.as_dict() for name, finding in found.items()}
    return verdict_of(found.values(), evidence, good=good, guard=guard)


def _of_both_axes(case: Case, about_second: NDArray[np.bool_], guard: Guard) -> Verdict:
    """The verdicts of both axes as one; each judges the tilts about it with the geometry of one axis."""
    result, verdicts = case.result, list[Verdict]()
    for second in (False, True):
        images, volume = result.projections[about_second == second], result.volume.attenuation
        if second:
            images, volume = own_images(images), own_images(volume)
        shown: Any = SimpleNamespace(volume=replace(result.volume, attenuation=volume), projections=images)
        shown.fit_result, shown.noise_model = result.fit_result, result.noise_model
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
