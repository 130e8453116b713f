"""Processor time of `noiseflow calibrate`: `python -m benchmarks.pages.calibration_time [--only WORD] [--page]`.

Simulated exposures are written to files, and the command runs from there to model and report, on one thread. The page
calibration_time.md is written from ``results/calibration_time.json``, where rows that are not measured again stay.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER

COMMAND = "python -m benchmarks.pages.calibration_time"
RESULTS, PAGE = FOLDER / "results" / "calibration_time.json", FOLDER / "calibration_time.md"
PICTURE = FOLDER / "calibration_time.png"
CASES: dict[str, tuple[str, tuple[str, ...], float | None]] = {
    "pair 256": ("a pair of 256² pixels", ("--short", "--long"), 2.0),
    "pair 1024": ("a pair of 1024² pixels", ("--short", "--long"), None),
    "pair 2048": ("a pair of 2048² pixels", ("--short", "--long"), 10.0),
    "flats": ("100 flats of 44 × 52 pixels and as many darks", ("--flat", "--dark"), 5.0),
    "burst": ("a burst of 100 frames of 44 × 52 pixels", ("--short",), None),
}
"""Cases, the options they need, and the goal in seconds."""


def exposures(name: str) -> list[Any]:
    """The frames of a case, in the order of its options."""
    from tests.calibration.simulators import RATIO, exposed, random_scene

    generator = np.random.default_rng(0)
    if name.startswith("pair"):
        scene = random_scene(generator, int(name.split()[1]))
        return [exposed(generator, times * scene) for times in (1, RATIO)]
    scene = random_scene(generator, 52)[:44]
    light = np.full((100, 44, 52), 200.0) if name == "flats" else np.broadcast_to(scene, (100, 44, 52))
    return [exposed(generator, electrons) for electrons in (light, 0 * light)]


def measured(name: str) -> dict[str, Any]:
    """Processor seconds of the command on a case, and the gain it reports (2 counts per electron are true)."""
    from benchmarks.provenance import origin
    from noiseflow.io import write

    with tempfile.TemporaryDirectory() as folder:
        words: list[str] = []
        for option, frames in zip(CASES[name][1], exposures(name), strict=False):
            words += [option, f"{folder}/{option[2:]}.tif"]
            write(Path(words[-1]), frames.astype(np.uint16))
        words += ["-o", f"{folder}/model.safetensors", "--report", f"{folder}/report", "--json"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [sys.executable, "-m", "noiseflow", "calibrate", *words],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": seconds, "gain": gain_of(json.loads(done.stdout))} | origin()


def gain_of(found: dict[str, Any]) -> float:
    """The gain in the command's JSON: of a detector, or of flats and darks."""
    gain = found["detector"]["gain"] if "detector" in found else found["camera"]["gain"]
    return float(gain["median"] if isinstance(gain, dict) else gain)


def draw(found: dict[str, Any]) -> None:
    """Draw the processor time of each case and its goal."""
    from benchmarks.pages import dots

    times = {name: row["seconds"] for name, row in found["cells"].items()}
    goals = {name: goal for name in times if (goal := CASES[name][2])}
    panel = ("noiseflow calibrate, one thread", "processor time (s)", {"measured": times, "goal": goals})
    dots.save(PICTURE, [panel], columns=1)


def page(found: dict[str, Any]) -> str:
    """The page as Markdown."""
    from benchmarks.provenance import measured_on

    lines = [
        "# Calibration: processor time\n",
        f"![Processor time of noiseflow calibrate by kind of exposures, and the goals]({PICTURE.name})\n",
        "*Processor time of each kind of exposures, in the order of the table, and its goal where there is one.*\n",
        f"Written by `{COMMAND}`: `noiseflow calibrate` from files to model and report, on one thread, the start of Python "
        "included, without compiling its files. Simulated detectors of gain 2 counts per electron, offset 100 counts and read "
        "noise 3 e⁻. Pixels enter the "
        "posterior as histograms at levels of the signal, of all frames of a burst together; noise models are fitted to 32 768 "
        "pixels and judged by 131 072 (`calibration/detector/models.py` has the reason).\n",
        "| exposures | processor time | goal | gain |\n|---|---|---|---|",
    ]
    for name, row in found["cells"].items():
        title, _, goal = CASES[name]
        lines.append(f"| {title} | {row['seconds']:.1f} s | {f'{goal:g} s' if goal else '–'} | {row['gain']:.3f} |")
    return "\n".join(lines) + f"\n\n{measured_on([found])}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--page", action="store_true", help="write the page only")
    arguments = parser.parse_args()
    from benchmarks.provenance import machine

    found = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {"cells": {}}
    if not arguments.page:
        rows = found["cells"]
        # compiled once, as an installation is: else each run compiled all files again where Python may not write them
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = str(Path(tempfile.gettempdir()) / "noiseflow_calibration_time")
        measured(next(iter(CASES)))
        for name in CASES:
            if arguments.only in name:
                rows[name] = measured(name)
                print(name, rows[name], flush=True)
        found = {"cells": {name: rows[name] for name in CASES if name in rows}, "machines": [machine()]}
        RESULTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    draw(found)
    PAGE.write_text(page(found), encoding="utf-8")


if __name__ == "__main__":
    main()
