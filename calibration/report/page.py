"""HTML reports of a calibration from a scene (verdict, detector, noise models, registration), and of one from flats and darks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.camera import Camera, figures_of_camera
from calibration.detector.figures import Figures
from calibration.detector.measure import EXCESS_NOISE
from calibration.detector.models import ModelScore, foremost, simplest_sufficient, too_light
from calibration.detector.posterior import Interval
from calibration.exposures.frames import rails
from calibration.pipeline import Findings
from calibration.registration.aligned import AlignedPair
from calibration.registration.bursts import BurstReport
from calibration.report import figures as draw
from calibration.report.exports import FILES, figures_of_exposures, unknown_read_noise, write_exports
from calibration.tolerances import EXCESS, MISALIGNED
from noiseflow.commands.console import Output
from noiseflow.metrics.distances import BEYOND
from noiseflow.report import Chart, Report, add_verdict, provenance

NEXT = "noiseflow sample adds this noise to clean images; noiseflow reconstruct --noise-model keeps it fixed."

UNKNOWN_RESPONSE = (
    "These exposures do not determine whether the response is linear, so the gain's interval includes exponents of the response "
    "from 0.8 to 1.2; add dark frames or --exposure-ratio to measure it."
)

PEAKS = "Single electrons are resolved: the gain is the distance of their peaks, whatever the response."

UNKNOWN_READ_NOISE = "These exposures determine only an upper limit of the read noise; add dark frames to measure it."

TABLE_HEADER = (
    *("model", "held-out NLL", "± s.e.", "above best", "± s.e."),
    *("JSD", "floor", "1 − BC", "floor", "BD", "floor", "JSD by signal", "floor"),
)


def table_rows(scores: Sequence[ModelScore]) -> list[list[str]]:
    """Return the scores of each model as text; divergences, in units of 10⁻⁴, of the foremost ones."""
    compared, rows = foremost(scores) if scores else [], []
    for score in scores:
        likelihood = (score.nll, score.nll_error, score.excess, score.excess_error)
        cells = 8 * ["–"]
        if score in compared:
            judged, one = score.evaluation, score.evaluation.overall
            pairs = (one.jsd, one.jsd_floor, 1 - one.bc, 1 - one.bc_floor, one.bd, one.bd_floor)
            cells = [f"{1e4 * value:.2f}" for value in (*pairs, judged.mean_jsd, judged.mean_jsd_floor)]
        rows.append([score.label, *(f"{value:.5f}" for value in likelihood), *cells])
    return rows


def verdict(scores: Sequence[ModelScore], *, negligible: float = 5e-4) -> str:
    """Describe which model suffices, and how much worse the next simpler one is.

    A Jensen-Shannon divergence, nats, may be negligible and still exceed its floor with many pixels.
    """
    chosen = simplest_sufficient(scores)
    simpler = [score for score in scores[: list(scores).index(chosen)] if np.isfinite(score.excess)]
    text = (
        f"The {chosen.label} model suffices: it is the simplest whose likelihood of held-out pixels is within one "
        "standard error of the best."
    )
    if simpler:
        nearest = min(simpler, key=lambda score: score.excess)
        text += (
            f" The best simpler model, {nearest.label}, is worse by {nearest.excess:.4f} ± "
            f"{nearest.excess_error:.4f} nats per pixel."
        )
    overall = chosen.evaluation.overall
    if overall.jsd > max(3 * overall.jsd_floor, negligible):
        text += (
            f" However, its histogram differs from the data by {overall.jsd / overall.jsd_floor:.1f} times the "
            "finite-sample floor: check the histograms before you use it."
        )
    heavy = max(chosen.evaluation.tails, key=lambda one: one.observed[1] - one.expected[1])
    if too_light(heavy):
        text += (
            f" Its tails are too light: at {heavy.signal:.4g} counts {heavy.observed[1]:.2%} of the pixels lie beyond four "
            f"standard deviations, of the model's {heavy.expected[1]:.2%} (random telegraph noise, sparks or a changing scene)."
        )
    return text


def interval_line(named: Sequence[tuple[str, str, Interval | None]]) -> str:
    """Figures (name, unit, interval) in one line."""
    return ", ".join(f"{name} {_interval(value, unit)}" for name, unit, value in named)


def print_details(findings: Findings, out: Output) -> None:
    """Print registration, detector and the scores of all noise models."""
    if findings.burst is not None:
        out.line(describe_burst(findings.burst))
    for number, pair in enumerate(findings.pairs if findings.burst is None else [], 1):
        out.line(f"\nPair {number}: {describe_registration(pair)}")
    out.line("\n" + describe_detector(findings))
    out.line("\nDivergences in units of 1e-4; floor: expected value for samples drawn from the model itself")
    out.table(TABLE_HEADER, table_rows(findings.scores))
    if findings.scores:
        out.line("\n" + verdict(findings.scores))


def named_figures(figures: Figures) -> list[tuple[str, str, Interval | None]]:
    units = {"gain": "counts/e⁻", "offset": "counts", "read_noise": "e⁻ rms"}
    found = [(name.replace("_", " "), unit, getattr(figures, name)) for name, unit in units.items()]
    return [*found, *_excess(figures.excess)]


def _excess(found: Interval | None) -> list[tuple[str, str, Interval | None]]:
    return [("excess-noise factor in the gain", "", found)] if found is not None and found.q05 > EXCESS else []


def _interval(value: Interval | None, unit: str) -> str:
    if value is None:
        return "not determined"
    return f"{value.median:#.4g} {unit} (90 %: {value.q05:#.4g} … {value.q95:#.4g})"


def describe_detector(findings: Findings) -> str:
    """Describe the method, the limits of the results, and the sampling of the posterior."""
    detector, figures = findings.detector, findings.figures
    if detector is None or figures is None:
        return f"Not measured: {findings.no_detector}"
    found = detector.posterior
    parts = [
        f"1 count = {1 / figures.gain.median:.4g} e⁻.",
        f"Method: {'posterior of a Poisson-Gaussian detector' if figures.source == 'posterior' else 'photon transfer'}"
        + (f"; variance multiplied by {figures.factor:.3g} for pixel correlation." if figures.factor != 1 else "."),
        f"{found.effective:.0f} effective samples, R-hat {found.rhat:.3f}, χ² per degree of freedom {detector.misfit:.2f}.",
    ]
    if not detector.levels:
        parts[1:] = ["Method: whole pixel values from 0 whose variance is their mean, which are counts of photons."]
    if figures.linear is not None and figures.linear != figures.gain:
        parts.append(f"Gain of a linear response: {_interval(figures.linear, 'counts/e⁻')}.")
    if figures.read_noise is not None and unknown_read_noise(figures):
        parts.append(UNKNOWN_READ_NOISE)
    response = detector.response
    known = f"Response to light: exponent {response.exponent:.3f} ± {response.error:.3f}."
    exponent = PEAKS if detector.electrons else known if response.known else UNKNOWN_RESPONSE
    return " ".join([*parts, exponent, EXCESS_NOISE])


def describe_burst(burst: BurstReport) -> str:
    """Describe drift and dose along a burst."""
    done = "the other frames were warped onto each frame before the comparison."
    done = done if burst.drifting else "the frames were compared without registration."
    drift = f"Largest drift between frames {burst.drift:.2f} px; {done}"
    drift = drift if np.isfinite(burst.drift) else "The scene has too few features to measure drift."
    dose = f" Relative dose from {burst.dose.min():.4f} to {burst.dose.max():.4f}"
    text = drift + dose + (": it changes along the burst." if burst.fading else ", constant within its error.")
    return text + (f" {burst.outliers} outliers of single frames were replaced." if burst.outliers else "")


def describe_registration(pair: AlignedPair) -> str:
    """Describe the registration of a pair."""
    found = pair.registration
    x, y = found.shift(pair.short.shape)
    method = f"SIFT, {found.inliers} of {found.matches} matches" if found.method == "sift" else found.method
    counts = pair.counts
    ratio = f"fitted exposure ratio {1 / pair.scaling.slope:.4g}"
    if pair.exposure_ratio is not None and not pair.one_setting:
        ratio += (
            f", not {pair.exposure_ratio:.4g} as given: the exposures are not unprocessed frames of one detector setting, "
            "so their ratio does not determine the offset"
        )
    return (
        f"{found.motion} motion by {method}: shift ({x:.2f}, {y:.2f}) px, rotation {found.rotation:.3f}°, scale "
        f"{found.scale:.5f}, standard error {found.error_px:.3f} px, rms of the matches {found.rms_px:.2f} px; {ratio}. "
        f"Excluded: {counts.outside} pixels outside the long exposure, {counts.saturated} saturated, {counts.hot} hot, "
        f"{counts.dead} dead"
        + (f", {counts.outliers} at outliers of one exposure" if counts.outliers else "")
        + (f", {counts.restless} in changing regions." if counts.restless else ".")
    )


def write_report(
    folder: str | Path, findings: Findings, *, inputs: Sequence[str | Path] = (), seed: int | None = None
) -> Path:
    """Write ``report.html`` with the exports of `write_exports` to a folder, which is created if necessary; return its path.

    Args:
        findings: results of the calibration.
        inputs: input files; the report lists their checksums.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> import tempfile
        >>> findings = calibration.Findings(calibration.align_burst(calibration.Burst(frames))[0])
        >>> calibration.write_report(tempfile.mkdtemp(), findings).name
        'report.html'
    """
    page = Report("Detector calibration")
    page.columns(lambda: _add_result(page, findings), lambda: _add_detector(page, findings))
    _add_details(page, findings)
    _add_models(page, findings)
    _add_registration(page, findings)
    page.heading("Provenance", folded=True)
    page.table(("item", "value"), provenance(inputs, seed=seed), prose=True)
    saved = page.save(Path(folder) / FILES[0])
    short, grade = findings.pairs[0].short, findings.verdict.grade
    write_exports(folder, figures_of_exposures(findings), top=rails(short)[1], shape=short.shape, verdict=grade)
    return saved


def _add_result(page: Report, findings: Findings) -> None:
    found = [] if findings.figures is None else named_figures(findings.figures)
    facts = [(f"{name[0].upper()}{name[1:]}", _interval(value, unit)) for name, unit, value in found]
    page.facts([*facts, *(("Noise model", simplest_sufficient(one).label) for one in [findings.scores] if one)])
    add_verdict(page, findings.verdict, next_step=NEXT)
    if findings.scores:
        page.text(verdict(findings.scores))


def _add_detector(page: Report, findings: Findings) -> None:
    page.heading("Detector")
    if findings.detector is None:
        page.text(describe_detector(findings))
        return
    charts, figures = draw.photon_transfer_charts(findings.detector), findings.figures
    if figures is not None and figures.read_noise is not None and figures.offset is not None:
        charts.append(draw.snr_of(figures, float(findings.detector.line.signal.max())))
    page.charts(
        charts,
        caption="Photon transfer: variance against signal (band: 90 % posterior interval), deviation from the fitted line, and "
        "signal-to-noise ratio of one pixel.",
    )


def _add_details(page: Report, findings: Findings) -> None:
    if findings.detector is None:
        return
    page.heading("Measurement", folded=True)
    page.text(describe_detector(findings))
    if findings.correlation:
        caption = "Correlation of the residuals between pixels; independent noise has zero correlation."
        page.charts(draw.correlation_charts(findings.correlation), caption=caption)
    page.charts(draw.corner_charts(findings.detector), caption="Posterior of gain, offset and read noise, in pairs.")


def _add_models(page: Report, findings: Findings) -> None:
    page.heading("Noise models", folded=True)
    caption = (
        "NLL: negative log-likelihood of held-out pixels, nats per pixel; lower is better. JSD (nats), "
        "1 − BC (Bhattacharyya coefficient) and BD (Bhattacharyya distance, nats) in units of 10⁻⁴; floor: expected value for "
        "samples drawn from the model itself."
    )
    page.table(TABLE_HEADER, table_rows(findings.scores), caption=caption)
    if findings.scores:
        chosen = simplest_sufficient(findings.scores)
        caption = f"Tails of the {chosen.label} model: share of held-out pixels beyond 3, 4 and 5 standard "
        header = ("signal, counts", *(f"beyond {k}σ{whose}" for k in BEYOND for whose in ("", ", model")))
        found = [(one.signal, zip(one.observed, one.expected, strict=True)) for one in chosen.evaluation.tails]
        rows = [[f"{at:.5g}", *(f"{100 * share:.3g}" for pair in pairs for share in pair)] for at, pairs in found]
        page.table(header, rows, caption=caption + "deviations, and the model's own, in per cent.")
    if findings.pixels is None:
        return
    compared = foremost(findings.scores)
    caption = "Residuals of the held-out pixels at each signal level, with the densities of the foremost models."
    page.charts(draw.histogram_charts(findings.pixels, compared), caption=caption)
    caption = "Probability integral transform (PIT) of held-out pixels, and QQ plot. Grey: range of a correct model."
    page.charts(draw.pit_charts(compared), caption=caption)


def _add_registration(page: Report, findings: Findings, *, most: int = 3) -> None:
    page.heading("Registration and residual", folded=True)
    if findings.burst is not None:
        page.text(describe_burst(findings.burst))
    elif findings.pairs:
        worst = max(pair.registration.error_px for pair in findings.pairs)
        advice = ", which is too large for fine detail: check the residuals." if worst > MISALIGNED else "."
        page.text(f"The exposures are registered to within {worst:.3f} px{advice}")
    for number, pair in enumerate(findings.pairs[:most], 1):
        page.text(f"Pair {number}: {describe_registration(pair)}")
        caption = "Overlay before and after registration: short exposure magenta, long green; grey where they agree."
        page.charts(draw.registration_charts(pair), caption=caption)
        caption = "Residual of the short exposure: map, and row and column means. It should have no structure."
        page.charts(draw.residual_charts(pair), caption=caption)
    if len(findings.pairs) > most:
        page.text(f"{len(findings.pairs) - most} more pairs are not shown.")


def write_camera_report(
    folder: str | Path, camera: Camera, *, inputs: Sequence[str | Path] = (), seed: int | None = None, listed: int = 50
) -> Path:
    """As `write_report`, of a camera with at most so many defective pixels listed."""
    page = Report("Camera calibration (EMVA 1288)")

    def figures() -> None:
        page.heading("Figures")
        page.table(("figure", "value"), [one.row for one in figures_of_camera(camera)], prose=True)

    page.columns(lambda: add_verdict(page, camera.verdict, next_step=NEXT), figures)
    page.heading("Photon transfer")
    caption = "Variance with the fitted line; deviation from the line; signal-to-noise ratio of a pixel."
    page.charts(transfer_charts(camera), caption=caption)
    caption = "Correlation of the temporal noise between pixels; independent pixels have zero correlation."
    page.charts(draw.correlation_charts(camera.figures.correlation), caption=caption)
    page.heading("Per-pixel maps")
    titles = {"offset": "Offset, counts", "variance": "Dark variance, counts²", "response": "Relative response"}
    maps = [draw.image_chart(camera.maps[name], title) for name, title in titles.items() if name in camera.maps]
    page.charts(maps, caption="Per-pixel maps; grey range from the 0.5th to the 99.8th percentile.")
    defects = np.argwhere(camera.maps["defects"] > 0)
    if len(defects):
        caption = f"The first {min(len(defects), listed)} of {len(defects)} defective pixels."
        names = [name for name in titles if name in camera.maps]
        rows = [[f"{y}", f"{x}", *(f"{camera.maps[name][y, x]:.4g}" for name in names)] for y, x in defects[:listed]]
        page.table(("y", "x", *names), rows, caption=caption)
    page.heading("Provenance", folded=True)
    page.table(("item", "value"), provenance(inputs, seed=seed), prose=True)
    saved = page.save(Path(folder) / FILES[0])
    shape, top = camera.maps["response"].shape, min(one.end for one in camera.figures.levels)
    write_exports(folder, figures_of_camera(camera), top=top, shape=shape, verdict=camera.verdict.grade)
    return saved


def intervals_of_camera(camera: Camera) -> str:
    """Gain, dark noise, offset and saturation in one line."""
    found = [("gain", "counts/e⁻", camera.figures.gain), ("dark noise", "e⁻ rms", camera.figures.dark_noise)]
    found += _excess(camera.figures.excess_factor)
    more = (f"{one.name} {one.text}" for one in figures_of_camera(camera) if one.symbol in ("μ_y.dark", "μ_e.sat"))
    return ", ".join([interval_line(found), *more])


def transfer_charts(camera: Camera) -> list[Chart]:
    """Draw variance against mean with the fitted line, its residual, and signal-to-noise ratio against electrons."""
    figures = camera.figures
    points = [*([figures.dark] if figures.dark else []), *figures.levels]
    mean, variance, error = np.transpose([(one.mean, one.variance, one.variance_error) for one in points])
    slope = figures.gain.median / max(figures.correlation.factor, 1e-30)
    base = next((one for one in points if not (one.clipped or one.coarse)), points[0])
    intercept = base.variance - slope * base.mean
    transfer = Chart("Photon transfer", x="mean, counts", y="temporal variance, counts²")
    transfer.plot(mean, slope * mean + intercept, label="fitted line")
    electrons = (mean - (figures.offset or 0.0)) / slope
    used = (electrons > 0) & (variance > 0)
    ratio = slope * electrons[used] / np.sqrt(variance[used])
    deviation = draw.deviation_chart(transfer, mean, variance, error, slope, intercept)
    return [transfer, deviation, draw.snr_chart(electrons[used], ratio)]
