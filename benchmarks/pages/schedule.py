"""What each number of a joint fit's plan earns: half and twice of it, on scenes of known truth and on a real series.

    python -m benchmarks.pages.schedule run [--scene shells/clipped] [--number trial]    # rows that are there are kept
    python -m benchmarks.pages.schedule page                                            # schedule.md from the JSON

25 scenes of 64³ (five phantoms, five noises) are judged by the PSNR of the volume, the real needle by that of the tilts left
out, as measured and with shot noise added. Each row is saved when it is done, in results/schedule.json.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks import needle
from benchmarks.pages import FOLDER, dots
from benchmarks.pages.joint_accuracy import NOISES, PHANTOMS
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, make_scene
from noiseflow.commands.console import Output
from noiseflow.io import atomic_path
from recon.joint.joint import JointReconstructor
from recon.joint.plan import Schedule
from recon.metrics.metrics import compare
from recon.series.tilt_series import TiltSeries

SIZE, TILTS = 64, "-58.5:58.5:3"
Judge = Callable[[Any], float]


def series(name: str) -> tuple[TiltSeries, Judge]:
    """A series by name, and what judges its volume, dB."""
    first, second = name.split("/")
    if first == "needle":
        parts = needle.split(needle.load(), second, "every fifth", seed=0)
        return parts.given, lambda volume: needle.psnr_of(parts, volume)
    scene = make_scene(SIZE, phantom=first, noise=second, tilts=TILTS)
    return scene.noisy, lambda volume: compare(volume, scene.truth).psnr


def names() -> list[str]:
    """Of all series; phantoms and noises vary together first, so that few rows already cover all of both."""
    order = [(p, (p + k) % len(NOISES)) for k in range(len(NOISES)) for p in range(len(PHANTOMS))]
    return [f"needle/{noise}" for noise in needle.NOISES] + [f"{PHANTOMS[p]}/{NOISES[n]}" for p, n in order]


def variants() -> Iterator[tuple[str, str, Schedule]]:
    """Number, what it is changed to, and the schedule."""
    usual = Schedule()
    yield "as planned", "", usual
    for each in fields(usual):
        value = getattr(usual, each.name)
        # twice a learning rate diverges on sparse objects: 1.5 times shows which way it would go
        for changed in (value // 2, value * 2) if isinstance(value, int) else (value / 2, value * 1.5):
            yield each.name, f"{changed:g}", replace(usual, **{each.name: changed})


def measure(name: str, schedule: Schedule) -> dict[str, float]:
    """PSNR and seconds of one fit with everything chosen."""
    tilt_series, judge = series(name)
    started = time.perf_counter()
    found = JointReconstructor(schedule=schedule)(tilt_series)
    return {"seconds": time.perf_counter() - started, "psnr": judge(found.volume.attenuation), "weight": found.weight}


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells, usual = content["cells"], Schedule()
    rows = []
    for number, changed, _ in variants():
        if number == "as planned":
            continue
        pairs = [
            (name, cells[f"{name}/as planned/"], cells[f"{name}/{number}/{changed}"])
            for name in names()
            if f"{name}/{number}/{changed}" in cells and f"{name}/as planned/" in cells
        ]
        simulated = [pair for pair in pairs if not pair[0].startswith("needle")]
        real = {pair[0]: f"{pair[2]['psnr'] - pair[1]['psnr']:+.2f}" for pair in pairs}
        if not simulated:
            continue
        gains = [new["psnr"] - old["psnr"] for _, old, new in simulated]
        error = statistics.stdev(gains) / len(gains) ** 0.5 if len(gains) > 1 else float("nan")
        times = statistics.median(new["seconds"] / old["seconds"] for _, old, new in simulated)
        rows.append(
            [
                f"`{number}`",
                f"{getattr(usual, number):g}",
                changed,
                f"{statistics.mean(gains):+.2f} ± {error:.2f}",
                f"{min(gains):+.2f} to {max(gains):+.2f}",
                *(real.get(f"needle/{noise}", "") for noise in needle.NOISES),
                f"{times:.2f}",
                str(len(gains)),
            ]
        )
    header = ["number", "is", "changed to", "mean gain (dB)", "range (dB)"]
    header += [f"needle, {noise} (dB)" for noise in needle.NOISES] + ["time", "scenes"]
    picture = "![Mean gain of the volume when a number of the plan is made smaller or larger](schedule.png)"
    head = (
        "A joint fit is a list of stages (`noiseflow reconstruct --dry-run` prints it); `recon.joint.plan.Schedule` contains "
        "its numbers of steps and learning rates. Each row changes one of them.\n\n"
        f"- **Gain, simulated**: change of the PSNR of the volume, over up to 25 scenes of {SIZE}³ voxels (five phantoms, five "
        "noises, one seed). Two fits of a scene differ by 0.1 to 0.3 dB, so only the mean and its standard error are "
        "significant.\n"
        "- **Gain, needle**: change of the PSNR of the left-out tilts of the real needle.\n"
        "- **Time**: median ratio to the unchanged plan; the machine had other work.\n\n"
        "Half and twice of most numbers change the mean by no more than chance; fewer steps of the volume and longer trials "
        "of weights cost. The differences of the needle with 10 counts are those of its weight, which these numbers "
        "move from 2.9 to 5.1.\n\n"
        "When these rows were measured, candidates of the noise took 30 steps of their own, half of which changed the mean by "
        "no more than chance (0.00 ± 0.01 dB); they take those of `adapt` since then.\n\n"
        "```sh\npython -m benchmarks.pages.schedule run\n```"
    )
    title = "# What each number of the plan contributes"
    return "\n\n".join([title, picture, head, table(header, rows), measured_on([content])]) + "\n"


def panel(cells: dict[str, Any]) -> dots.Panel:
    """Mean gain of the simulated scenes, by number and by the way it is changed."""
    series: dict[str, dict[str, float]] = {"smaller": {}, "larger": {}}
    usual = Schedule()
    for number, changed, _ in variants():
        gains = [
            row["psnr"] - cells[f"{name}/as planned/"]["psnr"]
            for name in names()
            if not name.startswith("needle") and (row := cells.get(f"{name}/{number}/{changed}"))
        ]
        if number != "as planned" and gains:
            series["smaller" if float(changed) < getattr(usual, number) else "larger"][number] = statistics.mean(gains)
    return "Numbers of the plan, changed one at a time", "mean gain of the volume (dB)", series


def main() -> None:
    """Run the chosen rows and save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--scene", action="append", choices=names(), help="of the series; all by default")
    parser.add_argument("--number", action="append", help="of the schedule; all by default")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "schedule.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results, output = Results(options.out, "schedule"), Output(json_mode=False)
    if options.part == "page":
        with atomic_path(FOLDER / "schedule.md") as partial:
            partial.write_text(page(results.content), encoding="utf-8")
        dots.save(FOLDER / "schedule.png", [panel(results.content["cells"])], columns=1)
        return
    for name in options.scene or names():
        for number, changed, schedule in variants():
            if options.number and number not in (*options.number, "as planned"):
                continue
            row = results.cell(f"{name}/{number}/{changed}", lambda n=name, s=schedule: measure(n, s))  # type: ignore[misc]
            output.line(f"{name}, {number} {changed}: {row['psnr']:.2f} dB, {row['seconds']:.1f} s")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"schedule.py: {error}")
