"""The results page of the calibration, calibration.md, from results/calibration.json alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER
from noiseflow.io import atomic_path
from noiseflow.report import new_figure

PAGE = FOLDER / "calibration.md"
TRIALS = PAGE.parent / "results" / "calibration_rows" / "parameters.jsonl"
COMMAND = "python -m benchmarks.pages.calibration"
Part = dict[str, Any]
KEYS = ("skewness", "quantile")


def write(content: Part) -> None:
    """Write the page and its picture."""
    draw([json.loads(line) for line in TRIALS.read_text(encoding="utf-8").splitlines()], PAGE.with_suffix(".png"))
    with atomic_path(PAGE) as partial:
        partial.write_text(page(content), encoding="utf-8")


def draw(trials: Sequence[Part], path: Path) -> None:
    """The measured over the true gain and read noise of every trial, with the 90 % intervals."""
    figure, axes = new_figure(2, width=12, height=3.6)
    for axis, name, along, label, ticks in (
        (axes[0, 0], "gain", "electrons", "mean level (e⁻)", (0.7, 0.8, 0.9, 1, 1.2, 1.4)),
        (axes[0, 1], "read_noise", "read_noise", "true read noise (e⁻ rms)", (0.3, 0.5, 1, 2, 3)),
    ):
        trials = [trial for trial in trials if trial.get(f"{name}_found")]
        at = np.array([trial[along] for trial in trials])
        low, middle, high = (
            np.array([trial[f"{name}_found"][key] / trial[name] for trial in trials])
            for key in ("q05", "median", "q95")
        )
        covers = (low <= 1) & (high >= 1)
        for chosen, colour, mark, words in (
            (covers, "#0072B2", "o", "interval contains the truth"),
            (~covers, "#D55E00", "s", "it does not"),
        ):
            bars = np.maximum([middle - low, high - middle], 0)[:, chosen]
            axis.errorbar(at[chosen], middle[chosen], bars, fmt=mark, color=colour, ms=3, lw=0.7, label=words)
        axis.axhline(1, color="black", lw=0.8)
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel=f"{name.replace('_', ' ')}, measured over true")
        axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_yticks([], minor=True)
        axis.set_ylim(ticks[0], ticks[-1] * 1.05)
        axis.xaxis.set_major_formatter("{x:g}")
        axis.legend(fontsize=8, title=f"{covers.sum()} of {len(covers)}", title_fontsize=8)
    with atomic_path(path) as partial:
        figure.savefig(partial, format="png", dpi=110, facecolor="white")


def page(content: Part) -> str:
    """The page as Markdown."""
    head = (
        "# Calibration: registration, detector parameters, real detectors\n\n"
        "![Measured over true gain and read noise of 300 simulated pairs, with 90 % intervals](calibration.png)\n\n"
        "*Gain and read noise of the simulated pairs of exposures under [Detector parameters](#detector-parameters): measured "
        f"over true value. Page and picture are written by `{COMMAND} page` from `results/calibration.json` and "
        "`results/calibration_rows`; interrupted runs resume.*"
    )
    parts = {
        "registration": _registration,
        "parameters": _parameters,
        "multiplied": _multiplied,
        "real": _real,
        "emva": _emva,
    }
    return "\n\n".join([head, *(_part(name, make, content) for name, make in parts.items())]) + "\n"


def _part(name: str, make: Any, content: Part) -> str:
    if name not in content:
        return f"## {name.capitalize()}\n\nNot measured: `{COMMAND} {name}`."
    found = content[name]
    if "recorded" in found:
        origin = f"recorded by commit {found['recorded']}, measured on the code shortly before it"
    else:
        origin = f"commit {found['commit']}" if found.get("commit") else "an earlier commit, not recorded"
    day = f", {found['date']}" if found.get("date") else ""
    return f"{make(found)}\n\n*Measured on two cores; {origin}{day}.*"


def _registration(found: Part) -> str:
    header = ["scene", "trials", "goal (px)", "rms error (px)", "median", "largest", "predicted rms", "success"]
    header += ["failures reported", "failures silent", "by SIFT"]
    rows = [
        [
            *(kind, str(one["trials"]), f"{one['limit_px']:g}", f"{one['rms_error_px']:.4f}"),
            *(f"{one[name]:.4f}" for name in ("median_error_px", "largest_error_px", "predicted_rms_px")),
            *(f"{one['success']:.1%}", str(one["detected_failures"]), str(one["silent_failures"])),
            f"{one['by_sift']:.0%}",
        ]
        for kind, one in found.items()
        if isinstance(one, dict)
    ]
    text = (
        f"`{COMMAND} registration`. Pairs of 256² pixels, with an exposure ratio of 16 and an SNR of 2 to 5 in the short "
        "exposure, are rotated by up to 3° and shifted by up to 10 %. The error is the rms over the frame against the known "
        "transform, in pixels. A failure is *reported* if `register` refuses the pair, and *silent* if it returns a transform "
        "with an error above the goal."
    )
    return f"## Registration\n\n{text}\n\n{table(header, rows)}"


def _parameters(found: Part) -> str:
    header = ["parameter", "coverage of 90 % intervals", "lower limit clips", "does not clip", "median error"]
    header += ["identifiable", "median error where identifiable"]
    rows = [
        [
            name.replace("_", " "),
            *(_percent(found[name][key]) for key in ("coverage_90", "coverage_90_clipped", "coverage_90_unclipped")),
            *(_percent(found[name].get(key), 2) for key in ("median_error",)),
            _percent(found[name].get("identifiable"), 0),
            _percent(found[name].get("median_error_identifiable"), 2),
        ]
        for name in ("gain", "read_noise", "offset")
    ]
    number, failed = found["trials"], len(found["failed"])
    error = (0.09 / max(number - failed, 1)) ** 0.5
    text = (
        f"`{COMMAND} parameters`. {number} simulated Poisson-Gaussian pairs of 384² pixels, {failed} refused: gain 0.5 to 20 "
        "counts per electron, read noise 0.2 to 10 e⁻, mean level 1 to 500 e⁻, all uniform in the logarithm, 8 to 16 bits. "
        "Half of them have offset 0, so that the lower limit clips. A parameter is *identifiable* if its 90 % interval spans "
        f"less than a factor of 1.5. The coverage of perfect intervals scatters by {error:.1%} over this number of trials. "
        "Goals: coverage 87 to 93 %, median error of gain 1 %, of identifiable read noise 5 %."
    )
    return f"## Detector parameters\n\n{text}\n\n{table(header, rows)}"


def _interval(found: Part | None) -> str:
    return f"{found['median']:.4g} ({found['q05']:.4g} … {found['q95']:.4g})" if found else "–"


def _multiplied(found: Part) -> str:
    cameras = {name: one for name, one in found.items() if isinstance(one, dict)}
    rows = [
        [
            name,
            f"{one['truth']['gain']:g}",
            _interval(one["gain"]),
            f"{one['truth']['excess_factor']:g}",
            _interval(one["excess_factor"]),
            ", ".join([one["verdict"], *one["reasons"]]),
        ]
        for name, one in cameras.items()
    ]
    header = ["multiplication", "true gain", "gain (counts/e⁻)", "true F²", "F²", "verdict"]
    tails = [
        [name, f"{tail['level']:g}", *(f"{tail[which][key]:.3g}" for key in KEYS for which in ("real", "sampled"))]
        for name, one in cameras.items()
        for tail in one["tails"]
    ]
    columns = ["multiplication", "electrons", "skewness, frames", "sampled", "99.9 % quantile, frames", "sampled"]
    text = (
        f"`{COMMAND} multiplied`. Simulated flats of 3 × 3 pixels, uneven by 3 %, {found['frames']} frames at each of six "
        "levels and as many dark frames, with and without multiplication; the gain with it includes the excess-noise factor "
        "F². Read noise of 8 e⁻, 5 e⁻ per count before multiplication."
    )
    tails_text = "New frames beside samples of the fitted model, as distances from each pixel's mean (counts):"
    return (
        f"## A small region of an EMCCD\n\n{text}\n\n{table(header, rows)}\n\n{tails_text}\n\n{table(columns, tails)}"
    )


def _real(found: Part) -> str:
    maps = found["miro_maps"]
    rows = [
        [
            name.replace("_", " "),
            *(_interval(one[key]) for key in ("gain", "offset", "read_noise")),
            f"{one['gain']['median'] / maps['gain']:.2f}",
            ", ".join([one["verdict"], *one["reasons"]]),
        ]
        for name, one in found.items()
        if isinstance(one, dict) and "verdict" in one
    ]
    header = ["exposures", "gain (counts/e⁻)", "offset (counts)", "read noise (e⁻)", "gain over map's", "verdict"]
    published = [
        [
            name.split("_")[0],
            *(f"{found[name][key]:.3f}" for key in ("gain", "offset", "read_noise_median_pixel", "read_noise_rms")),
        ]
        for name in ("miro_maps", "zhuang_maps")
    ]
    columns = ["detector", "gain, median", "offset, median", "read noise of the median pixel", "read noise, rms"]
    shares = found["zhuang_predicted"]
    text = (
        f"`{COMMAND} real --data FOLDER`. Published maps of the same pixels (gain in counts/e⁻, offset in counts, read noise in "
        f"e⁻):\n\n{table(columns, published)}\n\n"
        f"Measured from four short exposures and a long one of each colour:\n\n{table(header, rows)}\n\n"
        "The gain exceeds that of the maps by the factor in the table, and so does the scatter of these exposures: it is about "
        "20 % above the prediction of the maps. Figures that the verdict's reasons forbid are not reported.\n\n"
        f"`calibrate` refuses the {shares['frames']} frames of the other detector:\n\n"
        f"> {found['zhuang_burst']['refused']}\n\n"
        "The variance of frame differences, over the prediction of the maps, is "
        f"{shares['all']:.3f} for all pixels, {shares['dim']:.3f} for the dimmest 60 %, and {shares['still']:.3f} for the "
        f"{shares['still_pixels']:.0%} of pixels where the scene does not change."
    )
    return f"## Real detectors\n\n{text}"


def _emva(found: Part) -> str:
    tools = ("truth", "noiseflow", "emva1288", "getframes")
    rows = [
        [camera, label, *(_figure(one[tool].get(name)) for tool in tools)]
        for camera, one in found["cameras"].items()
        for name, label in found["names"].items()
    ]
    text = (
        "`python -m benchmarks.pages.calibration_emva`. The packages emva1288 (the standard's "
        f"reference implementation) and getframes measure the same frames: flats at {found['levels']} levels up to 1.2 "
        f"saturation capacities, {found['frames']} frames each, and {found['darks']} dark frames, 200² pixels; "
        "levels at which half of the pixels have the converter's largest value are left out.\n\n"
        "- **Temporal noise**: emva1288 uses two frames of each level.\n"
        "- **Linearity error**: that of emva1288 is the mean absolute deviation over the standard's range; emva1288 reports "
        "the extremes.\n"
        "- **Saturation**: the level of largest variance, and therefore in steps of the levels (7.5 %).\n"
        "- **Largest SNR**: noiseflow reports the largest measured one, near a full well that reduces the noise; emva1288 "
        "reports the square root of its capacity.\n"
        "- **Read noise of the sCMOS camera**: the truth is that of a typical pixel; both packages report the rms of all "
        "pixels.\n"
        "- **Range**: getframes fits its line up to nine tenths of the level of largest variance, where single pixels already "
        "saturate.\n"
        "- **Time**: processor time from arrays to figures, imports aside; noiseflow also measures the error bars, the maps, and "
        "the assumptions of its verdict."
    )
    return f"## EMVA 1288\n\n{text}\n\n{table(['camera', 'figure', *tools], rows)}"


def _figure(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4g}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _percent(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"
