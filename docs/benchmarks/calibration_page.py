"""The results page of the calibration, calibration.md, from results/calibration.json alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from noiseflow.io import atomic_path

PAGE = Path(__file__).parent / "calibration.md"
COMMAND = "python docs/benchmarks/calibration.py"
Part = dict[str, Any]


def write(content: Part) -> None:
    """Write the page."""
    with atomic_path(PAGE) as partial:
        partial.write_text(page(content), encoding="utf-8")


def page(content: Part) -> str:
    """The page as Markdown."""
    head = (
        "# Calibration: registration, detector parameters, real detectors, speed\n\n"
        f"Written by `{COMMAND} page` from `results/calibration.json`. Trials are kept line by line in "
        "`results/calibration_rows`; interrupted runs resume."
    )
    parts = {"registration": _registration, "parameters": _parameters, "real": _real, "emva": _emva, "speed": _speed}
    return "\n\n".join([head, *(_part(name, make, content) for name, make in parts.items())]) + "\n"


def _part(name: str, make: Any, content: Part) -> str:
    return (
        str(make(content[name])) if name in content else f"## {name.capitalize()}\n\nNot measured: `{COMMAND} {name}`."
    )


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
        f"`{COMMAND} registration`. Pairs of 256² pixels, exposure ratio 16, SNR 2 to 5 in the short one, turned by up to 3° and "
        "shifted by up to 10 %. Error: rms over the frame against the known transform. A failure is reported (`register` "
        "refuses), or silent (it answers, with an error above the goal)."
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
        "counts per electron, read noise 0.2 to 10 e⁻, mean level 1 to 500 e⁻, all uniform in the logarithm, 8 to 16 bits; "
        "half of them with offset 0, so that the lower limit clips. Identifiable: the 90 % interval spans less than a factor "
        f"of 1.5. A perfect interval's coverage scatters by {error:.1%} over so many trials. Goals: coverage 87 to 93 %, "
        "median error of gain 1 %, of read noise 5 % where identifiable."
    )
    return f"## Detector parameters\n\n{text}\n\n{table(header, rows)}"


def _real(found: Part) -> str:
    rows = []
    for name, one in found.items():
        if not isinstance(one, dict) or "gain" not in one or name.endswith("_maps"):
            continue
        maps = found["miro_maps"]
        cells = [
            f"{one[key]['median']:.4g} ({one[key]['q05']:.4g} … {one[key]['q95']:.4g})"
            for key in ("gain", "offset", "read_noise")
        ]
        rows.append(
            [name.replace("_", " "), *cells, f"{one['gain']['median'] / maps['gain']:.2f}", f"{one['misfit']:.2f}"]
        )
    header = ["exposures", "gain (counts/e⁻)", "offset (counts)", "read noise (e⁻)", "gain over map's", "χ²/dof"]
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
        f"`{COMMAND} real --data FOLDER`. Published maps of the same pixels:\n\n{table(columns, published)}\n\n"
        f"Measured from four short exposures and a long one of each colour:\n\n{table(header, rows)}\n\n"
        "The gain comes out above the maps' by the factor given, as the scatter of these exposures does (about 20 % "
        "above what the maps predict); χ² per degree of freedom far above 1 says that the camera's rescaled codes and "
        "uneven pixels are no single Poisson-Gaussian detector, so that the intervals are too narrow. The offset agrees to "
        "a few counts.\n\n"
        f'The other detector\'s {shares["frames"]} frames: `calibrate` says "{found["zhuang_burst"]["refused"]}". '
        "Variance of frame differences over what the maps predict: "
        f"{shares['all']:.3f} over all pixels, {shares['dim']:.3f} over the dim 60 %, and {shares['still']:.3f} over the "
        f"{shares['still_pixels']:.0%} of pixels where the scene stands still."
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
        f"`python docs/benchmarks/calibration_emva.py`, commit {found['commit']}. The packages emva1288 (the standard's "
        f"reference implementation) and getframes measure the same frames: flats at {found['levels']} levels up to 1.2 "
        f"saturation capacities, {found['frames']} frames each, and {found['darks']} dark frames, 200² pixels; "
        "levels of which half the "
        "pixels are at the converter's end are left out. The emva1288 package takes two frames of each level for temporal "
        "noise; its linearity error is the mean of the absolute deviations over the standard's range, and it reports their "
        "extremes. Saturation is the level of largest variance, so that it comes in steps of the levels (7.5 %). noiseflow's "
        "largest SNR is the largest measured, near a full well that cuts the noise; emva1288's is the root of its capacity. "
        "The preset's read noise of the sCMOS camera is that of its usual pixel, both packages report the rms of all. "
        "getframes extends its line to nine tenths of the level of largest variance, where single pixels saturate already."
    )
    return f"## EMVA 1288\n\n{text}\n\n{table(['camera', 'figure', *tools], rows)}"


def _figure(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4g}"


def _speed(found: Part) -> str:
    interval = found["detector"]["gain"]
    return (
        f"## Speed\n\n`{COMMAND} speed`: the command from files to model and report on a pair of {found['size']}² pixels takes "
        f"{found['wall_seconds']:.0f} s, {found['processor_seconds']:.0f} s of processor time (goal: 60 s on two cores); gain "
        f"{interval['median']:.4f} ({interval['q05']:.4f} … {interval['q95']:.4f}), truth 2."
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _percent(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"
