"""A real series with its own noise, judged by tilts that no method saw: X-ray projections of a tooth.

    python -m benchmarks.pages.tooth run tooth.h5 [--method NAME]   # rows that are not there yet
    python -m benchmarks.pages.tooth page                           # tooth.md from the JSON

The file is test data of tomopy and does not ship with this library. Each row is saved when it is done, in results/tooth.json.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.needle import GAPS, judged, load, methods, psnr_of, split
from benchmarks.other_series import tooth
from benchmarks.pages import FOLDER
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import EMPTY, Results
from benchmarks.search import STEPS, Best
from noiseflow.commands.console import Output
from noiseflow.io import atomic_path
from recon.methods import reconstruct
from recon.names import AUTO
from recon.series.tilt_series import VolumeGrid

_BINNED = 4  # pixels across: 148 of 594
_GAP = next(iter(GAPS))
_AUTO = "joint, field chosen"
_METHODS = (*methods(load(), lambda volume: 0.0), EMPTY, _AUTO)
_HEAD = f"""# A real series of X-ray projections

Each method reconstructs a tooth from four fifths of its 181 X-ray projections (0 to 179°, data of tomopy), and predicts every
fifth one, which no method saw. The images, two rows of 594 pixels, are divided by their flats and binned {_BINNED} times across.
{{doc}}`needle` defines PSNR and NLL, and says which settings are searched with the left-out tilts, which favours them; joint
fits choose their own. Least squares and L1 take {STEPS} steps. The prediction of an empty volume is a constant. All
angles are there, so that fields differ by how they interpolate, and not in a missing wedge.

Written by `python -m benchmarks.pages.tooth page` from `results/tooth.json`."""


def page(content: dict[str, Any]) -> str:
    """The page as Markdown, lowest NLL first."""
    rows = [
        [name, f"{row['psnr']:.2f}", f"{row['nll']:.4f}", row["setting"]]
        for name, row in sorted(content["cells"].items(), key=lambda item: item[1]["nll"])
    ]
    header = ["method", "PSNR (dB)", "NLL (nats per pixel)", "setting"]
    absent = [name for name in _METHODS if name not in content["cells"]]
    gaps = [f"Not run, for lack of time: {', '.join(absent)}."] if absent else []
    return "\n\n".join([_HEAD, table(header, rows), *gaps, measured_on([content])]) + "\n"


def main() -> None:
    """Run the chosen rows, save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("file", type=Path, nargs="?", help="tooth.h5, to run")
    parser.add_argument("--method", action="append", help="only this method")
    options = parser.parse_args()
    results, output = Results(FOLDER / "results" / "tooth.json", "tooth"), Output(json_mode=False)
    if options.part == "page":
        with atomic_path(FOLDER / "tooth.md") as partial_path:
            partial_path.write_text(page(results.content), encoding="utf-8")
        return
    if options.file is None:
        raise ValueError("name the file tooth.h5")
    torch.set_num_threads(1)
    parts = split(tooth(options.file, _BINNED), "as measured", _GAP, seed=0)
    grid = VolumeGrid.of(parts.given)
    makers = methods(parts.given, partial(psnr_of, parts))
    makers[EMPTY] = lambda: Best("no attenuation", np.zeros(grid.shape, np.float32), {})

    def field_chosen() -> Best:
        found = reconstruct(parts.given, grid, field=AUTO)
        setting = f"chose {str(found.choices['field']).split()[0]}, weight {found.choices['weight']:.3g}"
        return Best(setting, found.volume.attenuation, {})

    makers[_AUTO] = field_chosen
    for name in options.method or makers:
        row = results.cell(name, lambda m=makers[name]: judged(parts, m()))  # type: ignore[misc]
        output.line(f"{name}: {row['psnr']:.2f} dB, {row['nll']:.4f} nats per pixel ({row['setting']})")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"tooth.py: {error}")
