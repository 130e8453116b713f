"""The report of a reconstruction: volume, data, diagnostics, settings and provenance."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from noiseflow import io
from noiseflow.arrays import strided
from noiseflow.checks import Guard, Verdict
from noiseflow.installation import library_version
from noiseflow.io.mapped import mapped_copy
from noiseflow.metrics.spatial import SpatialStructure, spatial_structure
from noiseflow.models.wrapper import as_noise_model
from noiseflow.report import COLOURS, Chart, Report, add_verdict, grey_range, make_sprites, provenance
from noiseflow.runs.outputs import invocation
from noiseflow.statistics import bulk
from recon.methods._registry import find_method
from recon.metrics.metrics import fourier_shell_correlation, reach_in_words, resolution
from recon.reconstruction import Reconstruction
from recon.report.charts import add_differences, add_error_bars, limits_of, noise_charts
from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.uncertainty.posterior import CORRELATED

_NOT_SETTINGS = frozenset(
    {"tilts", "out", "report", "json", "seed", "device", "fsc", "reference", "resume", "checkpoint_interval"}
)
_NAMES = {
    "transmission": "bright field, I₀·exp(−line integral)",
    "linear": "linear (HAADF, EDX), line integral + offset",
}
_MODES = {"transmission": "bright-field images", "linear": "images of linear contrast (HAADF or EDX)"}
_PAPER = "H. Kniesel et al., Clean Implicit 3D Structure from Noisy 2D STEM Images, CVPR 2022, doi:10.1109/CVPR52688.2022.02018"
_NEXT = "noiseflow measure gives means, volumes and profiles, with intervals if error bars exist (--uncertainty 16)."
_UNITS = {"transmission": "attenuation per voxel", "linear": "detector units per voxel"}


def reconstruction_report(
    tilt_series: TiltSeries,
    outcome: Reconstruction,
    figures: Sequence[tuple[str, str]],
    *,
    inputs: Sequence[str | Path] = (),
    seed: int | None = None,
    halves: tuple[Volume, Volume] | None = None,
    reference: Volume | None = None,
    verdict: Verdict | None = None,
    guard: Guard | None = None,
) -> Report:
    """A page with slices, the tilt series and its prediction, the noise, the progress of the fit, settings and provenance.

    Args:
        figures: rows of the table, (name, value).
        inputs: input files, for their checksums.
        halves: reconstructions of the even and the odd tilts, for the Fourier shell correlation.
        reference: a reference volume for the Fourier shell correlation instead.
        verdict: the verdict, shown first with its charts.
        guard: records the parts of the page that fail; the others are shown.
    """
    name = Path(inputs[0]).name if inputs else "tilt series"
    report = Report(f"Reconstruction of {name}", f"{_NAMES[tilt_series.mode]}; method: {outcome.method}")
    guard = Guard() if guard is None else guard
    parts: dict[str, Callable[[], None]] = {
        "error bars": lambda: _add_uncertainty(report, tilt_series, outcome),
        "tilt series": lambda: _add_tilts(report, tilt_series, outcome),
        "differences of each image": lambda: add_differences(report, tilt_series, outcome),
        "beam and detector": lambda: _add_response(report, tilt_series, outcome),
        "noise": lambda: _add_noise(report, tilt_series, outcome),
        "convergence": lambda: _add_course(report, outcome),
        "resolution": lambda: _add_resolution(report, outcome.volume, halves, reference),
        "settings and methods": lambda: _add_words(report, tilt_series, outcome, verdict),
    }
    facts = [(key, value) for key, value in figures if key not in outcome.choices and len(value) < 40]

    def left() -> None:
        if (told := verdict) is not None:
            guard("report: verdict", lambda: add_verdict(report, told, next_step=_NEXT), otherwise=None)
        report.facts(facts)

    show = partial(add_volume, report, outcome.volume, _UNITS[tilt_series.mode])
    report.columns(left, lambda: guard("report: volume", show, otherwise=None))
    for part, add in parts.items():
        guard(f"report: {part}", add, otherwise=None)
    if (left_out := guard.in_words()) is not None:
        report.text(f"{left_out[0].upper()}{left_out[1:]}.")
    report.heading("Provenance", folded=True)
    report.table(("what", "value"), provenance(inputs, seed=seed), prose=True)
    return report


def _add_uncertainty(report: Report, tilt_series: TiltSeries, outcome: Reconstruction) -> None:
    if outcome.uncertainty is not None:
        add_error_bars(report, tilt_series, outcome.volume, outcome.uncertainty, _UNITS[tilt_series.mode])
    if outcome.caution is not None:
        report.text(f"{outcome.caution[0].upper()}{outcome.caution[1:]}.")


def _add_words(report: Report, tilt_series: TiltSeries, outcome: Reconstruction, verdict: Verdict | None) -> None:
    report.heading("Settings and choices", folded=True)
    report.table(("setting", "value", "evidence"), settings(outcome), prose=True)
    report.heading("Methods, to paste into a paper", folded=True)
    report.text(methods_paragraph(tilt_series, outcome, verdict))


def even_odd(tilt_series: TiltSeries) -> Iterator[TiltSeries]:
    """Two series of every other tilt, even tilts first, in the order of the stack. Raises ValueError if there are fewer than
    four tilts."""
    if tilt_series.num_tilts < 4:
        raise ValueError(f"{tilt_series.num_tilts} tilts are too few to split for --fsc; remove --fsc")
    yield from (tilt_series.select(slice(first, None, 2)) for first in (0, 1))


def read_reference(path: str | Path, grid: VolumeGrid) -> Volume:
    """Read a reference volume for the Fourier shell correlation. Raises FileNotFoundError if the file does not exist, and
    ValueError if it cannot be read, or is not a volume on this grid."""
    found = Volume.read(path, mapped=True)
    if found.attenuation.shape != grid.shape:
        raise ValueError(f"{path} has shape {found.attenuation.shape} and the volume {grid.shape}; they must be equal")
    io.require_finite(found.attenuation, path)
    return replace(found, attenuation=found.attenuation.astype(np.float32, copy=False))


def settings(outcome: Reconstruction) -> list[tuple[str, str, str]]:
    """Rows (setting, value, evidence) of user settings, defaults, and choices made from the data."""
    called = invocation()
    rows = [
        (name.replace("_", " "), _value_in_words(value), "given" if given else "default")
        for name, (value, given) in (called.options if called else {}).items()
        if name not in _NOT_SETTINGS and (given or value) and name not in outcome.choices
    ]
    if "denoised" not in outcome.method:
        rows = [row for row in rows if row[0] != "denoiser"]
    depth = outcome.volume.attenuation.shape[0]
    if not any(name == "thickness" for name, _, _ in rows):
        rows.append(("thickness", f"{depth} voxels", "default: equal to the image width"))
    return rows + [(name, _value_in_words(value), _evidence(name, outcome)) for name, value in outcome.choices.items()]


def _evidence(name: str, outcome: Reconstruction) -> str:
    tried = outcome.weights_tried
    called = invocation()
    if called is not None and called.options.get(name, (None, False))[1]:
        return "given"
    if name == "weight" and tried:
        return f"highest held-out likelihood of {len(tried)} weights, {min(tried):.3g} to {max(tried):.3g}, on a slab of slices"
    if name == "noise model" and outcome.method == "joint" and outcome.likelihood is None:
        return "clipping and rounding detected from the pixel values; the candidate that predicts held-out pixels best"
    if name in ("intensity", "offset"):
        return "estimated from the images, then refined in the fit"
    if name in ("tilts left out", "beam drift"):
        return "comparison of each tilt with a coarse volume of the others"
    if name in ("tilt axis (°)", "axis offset (pixels)", "largest shift (pixels)"):
        return "volumes with this axis explain held-out tilts best"
    return "set by the method" if outcome.method != "joint" else "found from the data"


def add_volume(report: Report, volume: Volume, unit: str, title: str = "Volume") -> None:
    """Add a section with an interactive view of a volume."""
    values = volume.attenuation
    sprites = make_sprites(values)
    size = None if volume.voxel_size is None else volume.voxel_size * values.shape[2] / sprites.shape[2]
    report.heading(title)
    options = {"original": list(values.shape), "limits": list(limits_of(values)), "voxelSize": size, "unit": unit}
    caption = f"Click or drag in a slice to move the others. {sprites.in_words()}"
    report.widget("volume", {"sprites": sprites.as_json()} | options, caption=caption)


def _add_tilts(report: Report, tilt_series: TiltSeries, outcome: Reconstruction) -> None:
    images, predicted = tilt_series.images, outcome.projections
    some = strided(images)
    ends = bulk(some)
    limits = float(min(ends[0], predicted.min())), float(max(ends[1], predicted.max()))
    both = mapped_copy(chain(images, predicted), (2 * len(images), *images.shape[1:]), np.float32)
    sprites = make_sprites(both, limits=limits, keep_sections=True)
    size = tilt_series.pixel_size
    data = {
        "sprites": sprites.as_json(),
        "angles": tilt_series.tilt_angles.tolist(),
        "start": int(np.argmin(np.abs(tilt_series.tilt_angles))),
        "limits": list(grey_range(some)),
        "names": ["data", "clean projection"],
        "unit": "detector units",
        "pixelSize": None if size is None else size * images.shape[2] / sprites.shape[2],
    }
    report.heading("Tilt series")
    words = sprites.in_words().replace(f"{sprites.original[0]} × ", "").replace(f"{sprites.shape[0]} × ", "")
    caption = f"The residuals of a good fit show noise without structure; waves along the tilts indicate misalignment. {words}"
    report.widget("tilts", data, caption=caption)


def _add_response(report: Report, tilt_series: TiltSeries, outcome: Reconstruction) -> None:
    """Charts of response parameters that differ between tilts; common parameters are listed with the choices."""
    order, charts = np.argsort(tilt_series.tilt_angles), []
    for name, values in outcome.response.items():
        if len(set(values)) > 1:
            unit = "" if name == "relative intensity" else ", detector units"
            charts.append(Chart(f"{name.capitalize()} of each tilt", x="tilt, degrees", y=name + unit))
            charts[-1].plot(tilt_series.tilt_angles[order], np.array(values)[order], dots=1.8)
    if charts:
        report.heading("Beam and detector", folded=True)
        report.charts(charts, caption="Estimated from the images, then refined in the fit.")


def _add_noise(report: Report, tilt_series: TiltSeries, outcome: Reconstruction) -> None:
    if outcome.noise_model is None:
        return
    images, predicted = (strided(stack).astype(np.float32) for stack in (tilt_series.images, outcome.projections))
    use = slice(None) if tilt_series.mask is None else strided(tilt_series.mask)
    report.heading("Noise", folded=True)
    caption = "Data: pixels of the tilt series against the clean projections of the volume. Model: computed exactly."
    report.charts(noise_charts(outcome.noise_model, predicted[use].ravel(), images[use].ravel()), caption=caption)
    device = as_noise_model(outcome.noise_model).device
    rows = contrast_slab(tilt_series, CORRELATED // (tilt_series.num_tilts * tilt_series.images.shape[2]) + 1)
    parts = (np.ascontiguousarray(stack[:, rows], np.float32) for stack in (outcome.projections, tilt_series.images))
    pair = (torch.from_numpy(part).to(device) for part in parts)
    report.text(f"Residuals under this model: {_in_words(spatial_structure(outcome.noise_model, *pair))}.")


def _in_words(structure: SpatialStructure, *, little: float = 0.05) -> str:
    """Description of correlations in the residuals; with many pixels, even `little` ones are statistically significant.

    Correlated residuals are no property of the detector here, but what the volume and the alignment leave unexplained; the
    verdict judges whether that is a fault."""
    figures, _, conclusion = structure.in_words().partition("; a per-pixel")
    if structure.suffices:
        return f"{figures}; a per-pixel{conclusion}"
    correlations = np.abs([structure.horizontal, structure.vertical, structure.pattern])
    if max(correlations.max(), (max(structure.rows, structure.columns) - 1) / 10) <= little:
        return f"{figures}; this is statistically significant, but too small to matter"
    return f"{figures}; the noise model includes this misfit of volume and alignment, and does not describe the detector alone"


def _add_course(report: Report, outcome: Reconstruction) -> None:
    charts = []
    if outcome.fit_result is not None and outcome.fit_result.history:
        history = outcome.fit_result.history
        charts.append(Chart("Progress of the fit", x="step", y="held-out NLL, nats per pixel"))
        charts[-1].plot(list(history), list(history.values()), dots=1.5)
    if outcome.weights_tried:
        tried = sorted(outcome.weights_tried.items())
        charts.append(Chart("Choice of the weight", x="weight of the total variation", y="held-out NLL", log="x"))
        charts[-1].plot(*zip(*tried, strict=True), dots=2.5)
        charts[-1].ticks["x"] = [(weight, f"{weight:.2g}") for weight, _ in tried]
        charts[-1].line(x=float(outcome.choices["weight"]))
    if charts:
        report.heading("Convergence", folded=True)
        report.charts(charts, caption="Negative log-likelihood of held-out pixels; lower is better.")


def _add_resolution(
    report: Report, volume: Volume, halves: tuple[Volume, Volume] | None, reference: Volume | None
) -> None:
    pairs = [] if halves is None else [(*halves, 0.143, "even and odd tilts")]
    pairs += [] if reference is None else [(volume, reference, 0.5, "volume and reference")]
    if not pairs:
        return
    chart = Chart("Fourier shell correlation", x="cycles per voxel", y="correlation")
    words, least = [], 0.0
    for (first, second, level, what), colour in zip(pairs, (COLOURS["accent"], COLOURS["warm"]), strict=False):
        frequency, correlation = fourier_shell_correlation(first.attenuation, second.attenuation)
        chart.plot(frequency, correlation, colour=colour, label=what)
        chart.line(y=level, colour=colour)
        least = min(least, float(correlation.min()))
        reach = reach_in_words(resolution(frequency, correlation, level), level, volume.voxel_size)
        words.append(f"Between {what} it {reach}.")
    chart.limits["y"] = least, 1.05
    report.heading("Resolution")
    report.charts([chart], caption=" ".join(words))


def methods_paragraph(tilt_series: TiltSeries, outcome: Reconstruction, verdict: Verdict | None = None) -> str:
    """Sentences with data, method, chosen parameters, grade, version and citation."""
    count, height, width = tilt_series.images.shape
    angles, shape = tilt_series.tilt_angles, outcome.volume.attenuation.shape
    size = outcome.volume.voxel_size
    chosen = ", ".join(f"{name} {_value_in_words(value)}" for name, value in outcome.choices.items())
    sentences = [
        f"A tilt series of {count} {_MODES[tilt_series.mode]} ({width} × {height} pixels, {angles.min():g}° to "
        f"{angles.max():g}°) was reconstructed with noiseflow {library_version()}, method {outcome.method}",
        f"The volume has {' × '.join(map(str, shape))} voxels (z, y, x)" + (f" of {size:.4g} Å" if size else ""),
    ]
    if chosen:
        sentences.append(f"Chosen and estimated values: {chosen}")
    if verdict is not None:
        reasons = "" if verdict.grade == "good" else f" ({'; '.join(verdict.reasons)})"
        sentences.append(f"The program graded the result {verdict.grade}{reasons}")
    if find_method(outcome.method).learns_noise:
        sentences.append(f"The noise was learnt together with the volume, following {_PAPER}")
    return ". ".join(sentences) + "."


def _value_in_words(value: object) -> str:
    if value is None or isinstance(value, bool):
        return "yes" if value else "no" if value is False else "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
