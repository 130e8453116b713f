"""A measured detector for other programs: plain values, a table of its figures, and parameters of detector simulators."""

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.camera import Figure
from calibration.detector.figures import Figures
from calibration.detector.measure import EXCESS_NOISE
from calibration.detector.models import ModelScore, foremost
from calibration.pipeline import Findings
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import EXCESS
from noiseflow.io import atomic_path
from noiseflow.report import Chart
from noiseflow.runs.ownership import is_own, signature

SERIES = ("setting", "figure", "unit", "value", "5 %", "95 %", "verdict")
"""Columns of a table of several settings."""

FILES = ("report.html", "detector.csv", "detector.json")
"""Files in the folder of a report."""


def figures_of_exposures(findings: Findings) -> list[Figure]:
    """Gain, offset and read noise from exposures of a scene; none if they were not measured."""
    found = findings.figures
    if found is None:
        return []
    return [
        Figure.of("system gain", "K", "counts/e-", found.gain),
        Figure.of("system gain, linear response", "", "counts/e-", found.linear),
        Figure.of("temporal dark noise", "σ_d", "e- rms", found.read_noise),
        Figure.of("offset", "μ_y.dark", "counts", found.offset),
        Figure.of("excess-noise factor", "", "", found.excess),
    ]


def simulators(figures: list[Figure], *, top: float, shape: tuple[int, ...]) -> dict[str, dict[str, Any]]:
    """Return the arguments of getframes' ``CameraConfig`` and micro-sim's cameras; those that were not measured are left out.

    Args:
        top: value at which the converter clips, counts; infinite if no pixel shows it, which gives 16 bits.
        shape: (y, x) of the frames.
    """
    known = {figure.name: figure.value for figure in figures if figure.value is not None}
    top = top if math.isfinite(top) else 2**16 - 1
    gain, bits = known["system gain"], max(8, math.ceil(math.log2(top + 1)))
    excess = known.get("excess-noise factor", 1.0)
    multiplied = excess > EXCESS
    # the noise gives the product of gain and excess-noise factor
    gain = gain / excess if multiplied else gain
    offset, read_noise = known.get("offset"), known.get("temporal dark noise")
    if multiplied and read_noise is not None:
        read_noise = read_noise * excess
    full_well = known.get("saturation capacity", (top - (offset or 0.0)) / gain)
    getframes = {
        "sensor_type": "EMCCD" if multiplied else "CMOS",
        "resolution": list(shape),
        "full_well_e": full_well,
        "bit_depth": bits,
        "gain_e_per_adu": 1 / gain,
        "bias_offset_adu": offset,
        "read_noise_e": read_noise,
        "dark_current_e_per_s": known.get("dark current"),
        "prnu": known["photo-response nonuniformity"] / 100 if "photo-response nonuniformity" in known else None,
        "excess_noise_factor": math.sqrt(excess) if multiplied else None,
    }
    # its converter has full_well / (2^bits − 1) electrons per count
    microsim = {
        "class": "CameraEMCCD" if multiplied else "CameraCMOS",
        "full_well": round((2**bits - 1) / gain),
        "bit_depth": bits,
        "gain": 1.0,
        "offset": None if offset is None else round(offset),
        "read_noise": read_noise,
        "dark_current": known.get("dark current"),
    }
    return {
        name: {key: value for key, value in values.items() if value is not None}
        for name, values in (("getframes", getframes), ("microsim", microsim))
    }


def write_exports(
    folder: str | Path, figures: list[Figure], *, top: float, shape: tuple[int, ...], verdict: str
) -> list[Path]:
    """Write the table and the parameters (see `simulators`) to a folder that exists, and return their paths; nothing without a
    gain."""
    if not figures:
        return []
    table, parameters = (Path(folder) / name for name in FILES[1:])
    header = ("figure", "EMVA 1288", "unit", "value", "5 %", "95 %", "note")
    _write_table(table, header, [list(vars(one).values()) for one in figures])
    with atomic_path(parameters) as partial:
        found = {"written_by": signature(), "verdict": verdict} | simulators(figures, top=top, shape=shape)
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return [table, parameters]


def _write_table(path: Path, header: Sequence[str], rows: list[list[Any]]) -> None:
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        stream.write(f"# {signature()}\n")
        csv.writer(stream).writerows([header, *rows])


def unknown_read_noise(figures: Figures) -> bool:
    """Whether the exposures determine the read noise to no better than a factor of three."""
    interval = figures.read_noise
    return interval is None or interval.q95 > 3 * interval.q05


def summary(findings: Findings) -> dict[str, Any]:
    """Return the findings as plain values: ``verdict``, ``detector``, ``registration``, ``models``, ``burst``."""
    return {
        "verdict": findings.verdict.as_dict(),
        "detector": detector_summary(findings),
        "registration": [_registration(pair) for pair in findings.pairs],
        "models": {score.name: _figures(score, score in foremost(findings.scores)) for score in findings.scores},
        **({} if findings.burst is None else {"burst": vars(findings.burst)}),
    }


def detector_summary(findings: Findings) -> dict[str, Any] | None:
    """Return the detector's figures as plain values; None if they were not measured."""
    detector, figures = findings.detector, findings.figures
    if detector is None or figures is None:
        return None
    found = detector.posterior
    names = {"gain": "gain", "gain_if_linear": "linear", "offset": "offset", "read_noise": "read_noise"}
    intervals = {name: getattr(figures, one) for name, one in {**names, "excess_factor": "excess"}.items()}
    return {name: None if one is None else vars(one) for name, one in intervals.items()} | {
        "response": {name: getattr(detector.response, name) for name in ("exponent", "error", "known")},
        "source": figures.source,
        "correlation_factor": figures.factor,
        "rhat": found.rhat,
        "effective_samples": found.effective,
        "num_draws": found.num_draws,
        "misfit": detector.misfit,
        "photon_transfer_gain": detector.line.gain,
        "offset_measured": detector.offset is not None,
        "read_noise_identifiable": not unknown_read_noise(figures),
        "caveat": EXCESS_NOISE,
    }


def _registration(pair: AlignedPair) -> dict[str, Any]:
    found = pair.registration
    names = ("rms_px", "error_px", "inliers", "matches", "matrix", "method", "motion", "rotation", "scale", "inverted")
    slope = pair.scaling.slope
    scaling = {"slope": slope, "intercept": pair.scaling.intercept, "exposure_ratio": 1 / slope}
    values = {name: getattr(found, name) for name in names} | {"shift": found.shift(pair.short.shape)}
    return values | scaling | {"masked": vars(pair.counts)}


def _figures(score: ModelScore, compared: bool) -> dict[str, Any]:
    likelihood = {name: getattr(score, name) for name in ("nll", "nll_error", "excess", "excess_error")}
    if not compared:
        return likelihood
    judged, overall = score.evaluation, score.evaluation.overall
    by_signal = {"jsd_by_signal": judged.mean_jsd, "jsd_by_signal_floor": judged.mean_jsd_floor}
    more = {"ks": judged.ks, "ks_floor": judged.ks_floor, "tails": [vars(one) for one in judged.tails]}
    return likelihood | vars(overall) | by_signal | more


def add_to_series(path: Path, setting: float, figures: list[Figure], verdict: str) -> list[Path]:
    """Add the figures of one setting to a CSV table, in place of its former ones, and draw the gains beside it as SVG; return the
    paths of both. A table that does not exist is created."""
    rows = [row for row in read_series(path) if float(row["setting"]) != setting]
    for one in figures:
        values = (f"{setting:g}", one.name, one.unit, one.value, one.low, one.high, verdict)
        rows.append({name: "" if value is None else str(value) for name, value in zip(SERIES, values, strict=True)})
    rows.sort(key=lambda row: float(row["setting"]))
    chart = path.with_suffix(".svg")
    _write_table(path, SERIES, [[row[name] for name in SERIES] for row in rows])
    with atomic_path(chart) as partial:
        chart_of(rows).save(partial)
    return [path, chart]


def read_series(path: Path) -> list[dict[str, str]]:
    """Read the rows of a table; none if it does not exist. Raises ValueError if the file is no such table."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()[1:] if is_own(path) else []
    table = csv.DictReader(lines)
    if lines and tuple(table.fieldnames or ()) == SERIES:
        return list(table)
    raise ValueError(f"{path} is no table of a gain series; name a new file with --series")


def chart_of(rows: list[dict[str, str]]) -> Chart:
    """Draw the gain of each setting with its 90 % interval, and the line of gains proportional to the setting."""
    gains = [row for row in rows if row["figure"] == "system gain" and row["value"]]
    setting, value, low, high = (
        np.array([float(row[name] or row["value"]) for row in gains]) for name in ("setting", "value", "5 %", "95 %")
    )
    chart = Chart("Gain against setting", x="setting", y="gain, counts/e⁻", log="xy" if np.all(setting > 0) else "")
    chart.plot(setting, value, width=0.0, dots=2.5, label="gain and 90 % interval")
    for at, *ends in zip(setting, low, high, strict=True):
        chart.plot([at, at], ends, width=1.0)
    if len(setting) > 1 and np.all(setting > 0):
        line = setting * np.exp(np.mean(np.log(value / setting)))
        chart.plot(setting, line, dashes="4 3", label="proportional to the setting")
    return chart
