"""Do the intervals cover? `python -m benchmarks.pages.calibration_coverage [--trials N] [--only WORD] [--minutes M] [--page]`.

Simulated exposures of 128² pixels of Poisson-Gaussian detectors with random parameters are measured as `noiseflow calibrate`
does; a 90 % interval should hold the truth nine times in ten. Trials are kept line by line in ``results/coverage_rows``, and an
interrupted run resumes; calibration_coverage.md is written from them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER

ROWS = FOLDER / "results" / "coverage_rows"
MACHINES = ROWS / "machines.json"  # rows name theirs by its place in this list
PAGE, PICTURE = FOLDER / "calibration_coverage.md", FOLDER / "calibration_coverage.png"
COMMAND = "python -m benchmarks.pages.calibration_coverage"
SIZE, RATIO, FRAMES = 128, 16.0, 8
STEP = 20  # trials of one kind before the next kind's turn, so that an interrupted run has all of them
PARAMETERS = ("gain", "offset", "read_noise")
Row = dict[str, Any]


def truth_of(generator: np.random.Generator, kind: str) -> dict[str, float]:
    """Random parameters of a detector; gain, read noise and mean level uniform in the logarithm."""
    low, high = np.log([[0.5, 8.0], [1.0, 8.0], [20.0, 200.0]]).T
    gain, read_noise, mean = (float(value) for value in np.exp(generator.uniform(low, high)))
    offset = 0.0 if kind == "clipped below" else float(generator.uniform(50, 150)) + 5 * gain * read_noise
    return {"gain": gain, "offset": offset, "read_noise": read_noise, "mean": mean}


def found_of(kind: str, seed: int) -> Row:
    """One trial: the truth, and the intervals found."""
    from benchmarks.provenance import origin
    from calibration.exposures.frames import Burst, ExposurePair
    from calibration.pipeline import measure_exposures
    from tests.calibration.simulators import Image, exposed, random_scene

    generator = np.random.default_rng([seed, sorted(KINDS).index(kind)])
    truth = truth_of(generator, kind)
    scene = random_scene(generator, SIZE, mean=truth["mean"])
    detector: dict[str, Any] = {name: truth[name] for name in PARAMETERS}

    def taken(electrons: Image, **changes: Any) -> Image:
        return exposed(generator, electrons, **(detector | changes))

    dark = None
    if kind == "burst of 8 frames":
        exposures: Any = Burst(np.stack([taken(scene) for _ in range(FRAMES)]))
    elif (
        kind == "clipped above"
    ):  # the long exposure at a sixteenth of the gain, so that it clips where the short one does
        top = np.round(truth["offset"] + truth["gain"] * np.quantile(scene, 0.9))
        exposures = [ExposurePair(taken(scene, top=top), taken(RATIO * scene, gain=truth["gain"] / RATIO, top=top))]
    else:
        ratio = RATIO if kind == "ratio known" else None
        exposures = [ExposurePair(taken(scene), taken(RATIO * scene), ratio)]
        dark = Burst(np.stack([taken(0 * scene) for _ in range(FRAMES)]), calibration=True) if kind == "darks" else None
    row: Row = {"seed": seed, "truth": truth, "machine": machine_number()} | origin()
    started = time.process_time()
    try:
        found = measure_exposures(exposures, dark=dark)
    except ValueError as error:
        return row | {"refused": str(error)}
    row |= {"verdict": found.verdict.grade, "reasons": [one.reason for one in found.verdict.findings]}
    for name in PARAMETERS:
        value = getattr(found.figures, name) if found.figures else None
        row[name] = None if value is None else [value.q05, value.median, value.q95]
    return row | {"seconds": time.process_time() - started}


KINDS: dict[str, str] = {
    "ratio known": "a pair, exposure ratio 16 given",
    "ratio unknown": "a pair alone",
    "darks": "a pair with 8 dark frames, ratio unknown",
    "clipped below": "a pair alone, offset 0: the converter's lower end cuts the noise of dark pixels",
    "clipped above": "a pair alone, the brightest tenth of the scene beyond the converter's upper end",
    "burst of 8 frames": "equal exposures, no long one",
}


def machines() -> list[dict[str, Any]]:
    """The machines that rows name by number."""
    found: list[dict[str, Any]] = json.loads(MACHINES.read_text(encoding="utf-8")) if MACHINES.exists() else []
    return found


def machine_number() -> int:
    """The number of this machine, which enters the list with its first row."""
    from benchmarks.provenance import machine

    known, here = machines(), machine()
    if here not in known:
        known.append(here)
        MACHINES.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    return known.index(here)


def rows_of(kind: str) -> list[Row]:
    """The trials kept of a kind."""
    path = ROWS / f"{kind.replace(' ', '-')}.jsonl"
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def covered(rows: list[Row], name: str) -> tuple[int, int, float]:
    """Intervals that hold the truth, intervals given, and their median half-width: relative, in electrons for the offset."""
    given = [row for row in rows if row.get(name)]
    held = sum(row[name][0] <= row["truth"][name] <= row[name][2] for row in given)
    scale = [row["truth"]["gain"] if name == "offset" else row["truth"][name] for row in given]
    widths = [(row[name][2] - row[name][0]) / 2 / by for row, by in zip(given, scale, strict=True)]
    return held, len(given), float(np.median(widths)) if widths else float("nan")


def draw(trials: dict[str, list[Row]]) -> None:
    """Draw the share of intervals that contain the truth."""
    from benchmarks.pages import dots

    shares: dict[str, dict[str, float]] = {name.replace("_", " "): {} for name in PARAMETERS}
    for kind, rows in trials.items():
        for name in PARAMETERS:
            held, given, _ = covered(rows, name)
            if given:
                shares[name.replace("_", " ")][kind] = 100 * held / given
    panel = ("90 % intervals of simulated exposures", "intervals that contain the truth (%)", shares)
    dots.save(PICTURE, [panel], columns=1, line=90.0)


def page(trials: dict[str, list[Row]], known: list[dict[str, Any]]) -> str:
    """The page as Markdown."""
    from benchmarks.provenance import measured_on

    lines = [
        "# Calibration: do the intervals cover?\n",
        f"![Share of the 90 % intervals that contain the truth, by kind of exposures]({PICTURE.name})\n",
        "*Shares of intervals that contain the truth; the dashed line marks 90 %. Kinds are in the order of the table.*\n",
        "Each cell shows how many of the reported 90 % intervals contain the truth, and their median half-width (relative; in "
        "electrons for the offset). For perfect intervals, nine of ten repetitions of 300 trials lie between 87 and 93 %, of "
        "100 trials between 85 and 95 %.\n",
        "| exposures | trials | refused | verdict good | gain | offset | read noise |\n|---|---|---|---|---|---|---|",
    ]
    cells = {f"{kind} {row['seed']}": row for kind, rows in trials.items() for row in rows}
    for kind, rows in trials.items():
        columns = []
        for name in PARAMETERS:
            held, given, width = covered(rows, name)
            size = f"± {width:.2g} e⁻" if name == "offset" else f"± {width:.1%}"
            columns.append(f"{held} of {given} ({held / given:.0%}), {size}" if given else "not printed")
        refused = sum("refused" in row for row in rows)
        good = sum(row.get("verdict") == "good" for row in rows)
        lines.append(f"| {KINDS[kind]} | {len(rows)} | {refused} | {good} | " + " | ".join(columns) + " |")
    method = (
        f"## Method\n\nSimulated exposures have {SIZE}² pixels. Gain (0.5 to 8 counts per electron), read noise (1 to 8 e⁻) and "
        "mean level (20 to 200 e⁻) are uniform in the logarithm; long exposures are "
        f"{RATIO:g} times the short ones. Written by `{COMMAND}` from the trials in `results/coverage_rows`; the command resumes "
        "rows of fewer than 300 trials.\n\n"
        "Exposures without darks or a known ratio hardly separate offset from read noise. Their intervals cover two priors, "
        "low and high read noise. Because offset and read noise are bounded (read noise from below, the offset by the darkest "
        "pixels), these intervals contain the truth more often than nine times in ten. The same two priors apply to the gain: "
        "the noise determines it by its variance and, to a lesser extent, by its skewness, which read noise dilutes. If the "
        "skewness misleads, these priors alone contained the truth in 83 to 86 %. The intervals of exposures without darks or "
        "a known ratio therefore also cover the result of photon transfer."
    )
    numbers = {row.get("machine") for row in cells.values()}
    used: list[Any] = [None] if None in numbers else []
    used += [machine for number, machine in enumerate(known) if number in numbers]
    origin = measured_on([{"cells": cells, "machines": used}])
    return "\n".join(lines) + f"\n\n{method}\n\n{origin}\n"


def measure(kind: str, trials: int, stop: Callable[[], bool]) -> None:
    """Measure what is not kept yet."""
    ROWS.mkdir(parents=True, exist_ok=True)
    for seed in sorted(set(range(trials)) - {row["seed"] for row in rows_of(kind)}):
        if stop():
            return
        row = found_of(kind, seed)
        with (ROWS / f"{kind.replace(' ', '-')}.jsonl").open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=300, help="of each kind")
    parser.add_argument("--only", default="", help="kinds whose name holds this")
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after the trial done by then")
    parser.add_argument("--page", action="store_true", help="write the page only")
    arguments = parser.parse_args()
    end = time.monotonic() + 60 * arguments.minutes
    for trials in range(STEP, arguments.trials + STEP, STEP):
        for kind in KINDS:
            if arguments.only in kind and not arguments.page:
                measure(kind, min(trials, arguments.trials), lambda: time.monotonic() > end)
    found = {kind: rows_of(kind) for kind in KINDS}
    draw(found)
    PAGE.write_text(page(found, machines()), encoding="utf-8")
    print(PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
