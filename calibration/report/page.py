"""The calibration's page: was the pair registered, which noise model fits, and a verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.detector.figures import Figures
from calibration.detector.measure import EXCESS_NOISE
from calibration.detector.models import ModelScore, simplest_sufficient
from calibration.detector.posterior import Interval
from calibration.pipeline import Findings
from calibration.registration.aligned import AlignedPair
from calibration.registration.bursts import BurstReport
from calibration.report.figures import (
    corner_figure,
    correlation_figure,
    histogram_figure,
    photon_transfer_figure,
    pit_figure,
    registration_figure,
    residual_figure,
    snr_figure,
)
from noiseflow.io import output_folder
from noiseflow.report import Report, provenance

LARGEST_MISALIGNMENT = 0.1
"""Pixels of registration error that leave no trace in the residuals."""

UNKNOWN_READ_NOISE = "These exposures determine only an upper limit of the read noise; dark frames would fix it."

LEAST_DIVERGENCE = 5e-4
"""Jensen-Shannon divergence, nats, that no eye sees; many pixels make it exceed its floor all the same."""

LABELS = {
    "gaussian": "Gaussian, one width",
    "poisson": "Poisson",
    "poisson-gaussian": "Poisson-Gaussian",
    "counting": "counter with dead time",
    "excess-noise": "Poisson-Gaussian with excess noise",
    "signal-gaussian": "Gaussian, width by signal",
    "mixture": "mixture of Gaussians",
    "flow": "radial flow",
    "spline": "spline flow",
    "physics-flow": "Poisson-Gaussian corrected by a flow",
}
"""How the report calls the models."""

TABLE_HEADER = (
    *("model", "held-out NLL", "± s.e.", "above best", "± s.e."),
    *("JSD", "floor", "1 − BC", "floor", "distance", "floor", "JSD by signal", "floor"),
)


def table_rows(scores: Sequence[ModelScore]) -> list[list[str]]:
    """The figures of each model as text; divergences in units of 10⁻⁴."""
    return [_row(score) for score in scores]


def _row(score: ModelScore) -> list[str]:
    judged, overall = score.evaluation, score.evaluation.overall
    likelihood = (score.nll, score.nll_error, score.excess, score.excess_error)
    pairs = (
        *(overall.jsd, overall.jsd_floor, 1 - overall.bc, 1 - overall.bc_floor, overall.bd, overall.bd_floor),
        *(judged.mean_jsd, judged.mean_jsd_floor),
    )
    return [LABELS[score.name], *(f"{value:.5f}" for value in likelihood), *(f"{1e4 * value:.2f}" for value in pairs)]


def verdict(scores: Sequence[ModelScore]) -> str:
    """One or two sentences: which model suffices, and by how much the others fail."""
    chosen = simplest_sufficient(scores)
    simpler = [score for score in scores[: list(scores).index(chosen)] if np.isfinite(score.excess)]
    text = (
        f"The {LABELS[chosen.name]} model suffices: it is the simplest whose likelihood of held-out pixels is within one "
        "standard error of the best."
    )
    if simpler:
        nearest = min(simpler, key=lambda score: score.excess)
        text += (
            f" The nearest simpler one, {LABELS[nearest.name]}, loses {nearest.excess:.4f} ± "
            f"{nearest.excess_error:.4f} nats per pixel."
        )
    overall = chosen.evaluation.overall
    if overall.jsd > max(3 * overall.jsd_floor, LEAST_DIVERGENCE):
        text += (
            f" However, its histogram differs from the data by {overall.jsd / overall.jsd_floor:.1f} times the "
            "finite-sample floor: look at the histograms before you use it."
        )
    return text


def describe_figures(figures: Figures) -> str:
    """Gain, offset and read noise with their 90 % intervals, and what they rest on."""
    parts = [f"{name} {_interval(value, unit)}" for name, unit, value in _named(figures)]
    source = "the posterior of a Poisson-Gaussian detector" if figures.source == "posterior" else "photon transfer"
    corrected = f", variance times {figures.factor:.3g} for the correlation of pixels" if figures.factor != 1 else ""
    per_count = f"1 count = {1 / figures.gain.median:.4g} e⁻"
    return f"{', '.join(parts)} ({per_count}). By {source}{corrected}."


def _named(figures: Figures) -> list[tuple[str, str, Interval | None]]:
    return [
        ("gain", "counts/e⁻", figures.gain),
        ("offset", "counts", figures.offset),
        ("read noise", "e⁻ rms", figures.read_noise),
    ]


def _interval(value: Interval | None, unit: str) -> str:
    if value is None:
        return "not determined"
    return f"{value.median:#.4g} {unit} (90 %: {value.q05:#.4g} … {value.q95:#.4g})"


def describe_detector(findings: Findings) -> str:
    """The figures, what limits them, and how they were sampled."""
    detector, figures = findings.detector, findings.figures
    if detector is None or figures is None:
        return f"not measured: {findings.no_detector}"
    found = detector.posterior
    text = describe_figures(figures) + f" {found.num_steps / found.autocorrelation_time:.0f} effective samples, "
    text += f"R-hat {found.rhat:.3f}, χ² per degree of freedom {detector.misfit:.2f}. "
    if figures.read_noise is not None and unknown_read_noise(figures):
        text += UNKNOWN_READ_NOISE + " "
    return text + EXCESS_NOISE


def describe_burst(burst: BurstReport) -> str:
    """What moved or faded along a burst, in words."""
    if not np.isfinite(burst.drift):
        drift = "The scene has too few features to measure a drift."
    else:
        drift = f"Largest drift between frames {burst.drift:.2f} px; " + (
            "the other frames were moved onto each before they were compared."
            if burst.drifting
            else "the frames were compared as they are."
        )
    dose = f" Relative dose from {burst.dose.min():.4f} to {burst.dose.max():.4f}"
    return drift + dose + (": it changes along the burst." if burst.fading else ", constant within its error.")


def describe_registration(pair: AlignedPair) -> str:
    """The registration's figures in a sentence."""
    found = pair.registration
    x, y = found.shift(pair.short.shape)
    method = f"SIFT, {found.inliers} of {found.matches} matches" if found.method == "sift" else "phase correlation"
    counts = pair.counts
    ratio = f"long over short {1 / pair.scaling.slope:.4g} by their scale"
    if pair.exposure_ratio is not None and not pair.one_setting:
        ratio += (
            f", not {pair.exposure_ratio:.4g} as given: the two exposures are not unprocessed frames of one detector "
            "setting, so that their scale does not determine the offset"
        )
    return (
        f"{found.motion} motion by {method}: shift ({x:.2f}, {y:.2f}) px, rotation {found.rotation:.3f}°, scale "
        f"{found.scale:.5f}, standard error {found.error_px:.3f} px, matches' rms {found.rms_px:.2f} px; {ratio}. Left out: "
        f"{counts.outside} pixels outside the long exposure, {counts.saturated} saturated, {counts.hot} hot, "
        f"{counts.dead} dead" + (f", {counts.restless} in places that change." if counts.restless else ".")
    )


def write_report(
    folder: str | Path,
    findings: Findings,
    *,
    title: str = "Detector calibration",
    inputs: Sequence[str | Path] = (),
    seed: int | None = None,
) -> Path:
    """Write ``report.html`` into a folder, which is made if need be; returns its path.

    Args:
        folder: where to write.
        findings: what to tell.
        title: of the page.
        inputs: files that were read, for their checksums.
        seed: of the random choices.

    Example:
        >>> import calibration, noiseflow, pathlib, tempfile, torch
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> path = calibration.write_report(folder / "report", calibration.Findings(pairs))
        >>> path.name
        'report.html'
    """
    page = Report(title)
    page.facts(_facts(findings))
    page.heading("Verdict")
    for sentence in judge(findings):
        page.text(sentence)
    _add_detector(page, findings)
    _add_models(page, findings)
    _add_registration(page, findings)
    page.heading("Provenance")
    page.table(("what", "value"), provenance(inputs, seed=seed), prose=True)
    with output_folder(folder) as made:
        return page.save(made / "report.html")


def _facts(findings: Findings) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = [("Verdict", findings.verdict.grade)]
    if findings.figures is not None:
        for name, unit, value in _named(findings.figures):
            shown = "not determined" if value is None else f"{value.median:#.4g} ({value.q05:#.4g} … {value.q95:#.4g})"
            facts.append((f"{name[0].upper()}{name[1:]}, {unit}", shown))
    if findings.scores:
        facts.append(("Noise model", LABELS[simplest_sufficient(findings.scores).name]))
    return facts


def describe_verdict(findings: Findings) -> list[str]:
    """The grade and its reasons, a sentence each."""
    grade = findings.verdict.grade
    if grade == "good":
        return [
            "Verdict: good. You can trust gain, offset and read noise within their intervals; every assumption passed its test."
        ]
    head = "bad. Do not use the figures:" if grade == "bad" else "doubtful. Use the figures with these reservations:"
    return [f"Verdict: {head}", *(f"• {one.text[0].upper()}{one.text[1:]}" for one in findings.verdict.reasons)]


def judge(findings: Findings) -> list[str]:
    """What to believe, in words: the detector's parameters, the noise model, the registration."""
    found = describe_verdict(findings)
    if findings.scores:
        found.append(verdict(findings.scores))
    if findings.burst is None and findings.pairs:
        worst = max(pair.registration.error_px for pair in findings.pairs)
        found.append(
            f"The exposures are registered to {worst:.3f} px"
            + (", which is too coarse for fine detail: look at the residuals." if worst > LARGEST_MISALIGNMENT else ".")
        )
    return found


def unknown_read_noise(figures: Figures) -> bool:
    """Whether the exposures leave the read noise open by more than a factor of three."""
    interval = figures.read_noise
    return interval is None or interval.q95 > 3 * interval.q05


def _add_detector(page: Report, findings: Findings) -> None:
    page.heading("Detector")
    if findings.detector is None:
        page.text(f"Not measured: {findings.no_detector}")
        return
    words = describe_detector(findings)
    page.text(words[0].upper() + words[1:])
    page.figure(
        photon_transfer_figure(findings.detector),
        caption="Photon transfer: variance against signal, and its residual from the line; band: 90 % of the posterior.",
    )
    if findings.correlation is not None:
        page.figure(
            correlation_figure(findings.correlation),
            caption="Correlation of the residuals of neighbouring pixels; zero for independent noise.",
        )
    if findings.figures is not None and findings.figures.read_noise is not None and findings.figures.offset is not None:
        page.figure(
            snr_figure(findings.figures, float(findings.detector.line.signal.max())),
            caption="Signal-to-noise ratio of one pixel against its number of electrons, with the shot-noise limit.",
        )
    page.figure(corner_figure(findings.detector), caption="Posterior of gain, offset and read noise.")


def _add_models(page: Report, findings: Findings) -> None:
    page.heading("Noise models")
    caption = (
        "NLL: negative log-likelihood of held-out pixels, nats per pixel; lower is better. JSD (nats), "
        "1 − BC and Bhattacharyya distance in units of 10⁻⁴; floor: the value that samples of the model itself would reach."
    )
    page.table(TABLE_HEADER, table_rows(findings.scores), caption=caption)
    if findings.pixels is None:
        return
    histograms = histogram_figure(findings.pixels, findings.scores)
    page.figure(
        histograms,
        caption="Residuals of the held-out pixels at each signal level (grey), with every model on top.",
    )
    page.figure(
        pit_figure(findings.scores),
        caption="Each model on the held-out pixels: histogram of its probability integral transform (PIT), and QQ plot.",
    )


def _add_registration(page: Report, findings: Findings, *, most: int = 3) -> None:
    page.heading("Registration and residual")
    if findings.burst is not None:
        page.text(describe_burst(findings.burst))
    for number, pair in enumerate(findings.pairs[:most], 1):
        page.text(f"Pair {number}: {describe_registration(pair)}")
        page.figure(
            registration_figure(pair),
            caption="Overlay before and after registration. Magenta: short, green: long; grey where they agree.",
        )
        page.figure(
            residual_figure(pair), caption="Residual: map, and row and column profiles. It should have no structure."
        )
    if len(findings.pairs) > most:
        page.text(f"{len(findings.pairs) - most} more pairs are not drawn.")
