"""A raw series at full size, judged by tilts that no method saw: the needle of 256² pixels, aligned first.

    python -m benchmarks.pages.needle_256 needle_256_raw.mrc     # measures what is not there yet, and writes needle_256.md

The file is test data of etspy (usnistgov/etspy) and does not ship with this library. It is aligned once, with all
tilts, as `noiseflow reconstruct --refine-alignment` does. Results go to results/needle_256.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from benchmarks.needle import GAPS, Split, held_out_nll, predict, psnr_of, split
from benchmarks.pages import FOLDER, dots
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results
from benchmarks.search import Best, back_projections, best, sirts
from noiseflow.commands.console import Output
from noiseflow.io import atomic_path
from recon.methods import reconstruct
from recon.series.files import read_tilt_series
from recon.series.prepare import prepare
from recon.series.tilt_series import TiltSeries, VolumeGrid

RESULTS = FOLDER / "results" / "needle_256.json"
_MOST_ITERATIONS = 9  # of the numbers that are tried of SIRT: up to 256, where it is past its best
Cell = dict[str, Any]


def methods(given: TiltSeries, score: Callable[[Any], float]) -> dict[str, Callable[[], Best]]:
    """The best volume by method: the classical ones at their best setting, the others as a user gets them."""
    grid = VolumeGrid.of(given)

    def chosen(method: str) -> Best:
        result = reconstruct(given, grid, method=method)
        return Best(f"chose weight {result.weight:.3g}", result.volume.attenuation, {})

    return {
        "WBP": lambda: best(back_projections(given, grid, ("hann",)), score),
        "SIRT": lambda: best(islice(sirts(given, grid), _MOST_ITERATIONS), score),
        "L2": lambda: chosen("l2"),
        "joint": lambda: chosen("joint"),
    }


def measure(parts: Split, make: Callable[[], Best]) -> Cell:
    """Reconstruct, and judge by the tilts left out."""
    found = make()
    likely = predict(parts.given, found.volume, parts.left_out.tilt_angles, likely=True)
    return {
        "setting": found.setting,
        "psnr": psnr_of(parts, found.volume),
        "nll": held_out_nll(likely, parts.left_out.images),
    }


def page(content: dict[str, Any]) -> str:
    """The results as Markdown."""
    text = (
        "# A raw series of 256² with tilts left out\n\n"
        "![PSNR of the left-out tilts for every method, a panel for each way to leave tilts out](needle_256.png)\n\n"
        "This is the needle at full size, a raw HAADF-STEM series of 77 tilts of 256 × 256 pixels (data of usnistgov/etspy), "
        "aligned as by `noiseflow reconstruct --refine-alignment --tilt-axis 90`. {doc}`needle` defines PSNR and NLL. Least "
        "squares (L2) and the joint fit choose their settings automatically. WBP and SIRT take the settings with the best PSNR "
        "on the left-out tilts, which favours them. Pixels from outside the raw images are filled with the values of their "
        "neighbours, also in the left-out tilts.\n\n"
        "```sh\npython -m benchmarks.pages.needle_256 needle_256_raw.mrc\n```\n"
    )
    for gap in GAPS:
        rows = {key.split("/")[1]: row for key, row in content["cells"].items() if key.startswith(f"{gap}/")}
        text += f"\n## Left out: {gap}\n\n| method | PSNR (dB) | NLL (nats per pixel) | setting |\n"
        text += "| --- | ---: | ---: | --- |\n"
        for name, row in sorted(rows.items(), key=lambda item: -item[1]["psnr"]):
            text += f"| {name} | {row['psnr']:.2f} | {row['nll']:.4f} | {row['setting']} |\n"
    return text + "\n" + measured_on([content]) + "\n"


def panels(cells: dict[str, Any]) -> list[dots.Panel]:
    """PSNR of every method, best first, for each gap."""
    found = []
    for gap in GAPS:
        rows = {key.split("/")[1]: row["psnr"] for key, row in cells.items() if key.startswith(f"{gap}/")}
        ranked = dict(sorted(rows.items(), key=lambda item: -item[1]))
        found.append((f"left out: {gap}", "PSNR of the left-out tilts (dB)", {"": ranked}))
    return found


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("series", type=Path)
    parser.add_argument("--again", action="append", default=[], help="compute the rows of this method again")
    options = parser.parse_args()
    results, output = Results(RESULTS, "needle 256"), Output(json_mode=False)
    for name in options.again:
        results.forget(f"/{name}")
    series = read_tilt_series(options.series, mode="linear")
    aligned = prepare(series, tilt_axis=90.0, refine_alignment=True).tilt_series
    for gap in GAPS:
        parts = split(aligned, "as measured", gap, seed=0)
        for name, make in methods(parts.given, partial(psnr_of, parts)).items():
            row = results.cell(f"{gap}/{name}", partial(measure, parts, make))
            output.line(f"{gap}, {name}: {row['psnr']:.2f} dB, {row['nll']:.4f} nats per pixel")
    dots.save(FOLDER / "needle_256.png", panels(results.content["cells"]), columns=2)
    with atomic_path(FOLDER / "needle_256.md") as partial_page:
        partial_page.write_text(page(results.content), encoding="utf-8")


if __name__ == "__main__":
    main()
