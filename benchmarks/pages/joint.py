"""The joint reconstruction: its accuracy against the oracle and least squares, the choice of its field, and its speed.

    python -m benchmarks.pages.joint accuracy [--phantom shells] [--noise clipped]     # 25 rows; those already there are kept
    python -m benchmarks.pages.joint accuracy --again --same-weights   # rivals keep the weights that were best before
    python -m benchmarks.pages.joint fields [--phantom shells]         # which field is best when the true noise is known
    python -m benchmarks.pages.joint offset [--phantom shells]         # a known offset of a linear series, recovered
    python -m benchmarks.pages.joint speed [--row joint]               # ratios in one run; wants a quiet machine
    python -m benchmarks.pages.joint page                              # joint.md from the JSON
    python -m benchmarks.pages.joint accuracy --size 64 --tilts=-58.5:58.5:3 --out FILE      # other scenes

Each row is saved when it is done, in results/joint.json in docs/benchmarks, and is not computed again without --again. PSNR is
over the range of the truth, without any rescaling. Best weights are found by looking at the truth, which only the rivals may
do. ASTRA comes with the extra: python -m pip install '.[benchmark]' in the checkout.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import FOLDER, joint_page, joint_speed
from benchmarks.pages.joint_accuracy import NOISES, PHANTOMS, accuracy, fields, offset
from benchmarks.scenes import Results
from noiseflow.commands.console import Output

RESULTS = FOLDER / "results" / "joint.json"
SPEED: dict[str, Callable[[], dict[str, Any]]] = {
    "joint": lambda: joint_speed.joint(96),
    "chosen-64": lambda: joint_speed.chosen(64),
    "chosen-96": lambda: joint_speed.chosen(96),
    "chosen-256": lambda: joint_speed.chosen(256, repeats=1),
    "low-dose": lambda: joint_speed.cropped("low-dose"),
    "8-bit": lambda: joint_speed.cropped("8-bit"),
    "scaling": lambda: joint_speed.scaling([64, 96, 128, 192]),
    "scaling-quick": lambda: joint_speed.scaling([64, 96, 128]),
    "skipping-shells": lambda: joint_speed.skipping("shells", 96),
    "skipping-shells-192": lambda: joint_speed.skipping("shells", 192),
    "skipping-slab": lambda: joint_speed.skipping("slab", 96),
    "occupied-64": lambda: joint_speed.occupied(64),
    "occupied-96": lambda: joint_speed.occupied(96),
    "steps-shells": lambda: joint_speed.steps("shells", 96),
    "steps-shells-192": lambda: joint_speed.steps("shells", 192),
    "skipping-voxels-shells": lambda: joint_speed.skipping_voxels("shells"),
    "skipping-network-shells": lambda: joint_speed.skipping_network("shells"),
    "skipping-network-slab": lambda: joint_speed.skipping_network("slab"),
    "network": joint_speed.network,
    "projector-128": lambda: joint_speed.projector(128),
    "projector-256": lambda: joint_speed.projector(256),
}


def main() -> None:
    """Run the chosen rows, save each, and draw the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("accuracy", "fields", "offset", "speed", "page"))
    parser.add_argument("--phantom", action="append", choices=PHANTOMS)
    parser.add_argument("--noise", action="append", choices=NOISES)
    parser.add_argument("--row", action="append", choices=SPEED, help="of the speed rows; all by default")
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--same-weights", action="store_true", help="take the rivals' best weights from the kept rows")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--tilts", default=joint_speed.TILTS, help="START:STOP:STEP in degrees; 79 tilts by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--finer", type=int, default=2, help="of accuracy: how many times finer the true volume is projected"
    )
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, default=RESULTS, help="JSON file; by default the one of the page")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results, output = Results(options.out, "joint reconstruction"), Output(json_mode=False)

    def cell(key: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        if options.again:
            results.cells.pop(key, None)
        return results.cell(key, compute)

    scene = {"size": options.size, "tilts": options.tilts, "seed": options.seed}
    name = f"{options.size}/{options.tilts}/{options.seed}"
    if options.part == "accuracy":
        for phantom in options.phantom or PHANTOMS:
            for noise in options.noise or NOISES:
                key = f"accuracy/{phantom}/{noise}/{name}/{options.finer}"
                known = results.cells.get(key) if options.same_weights else None
                made = scene | {"finer": options.finer, "kept": known}
                row = cell(key, lambda p=phantom, n=noise, m=made: accuracy(p, n, **m))
                output.line(joint_page.accuracy_line(row))
    for part, measure in (("fields", fields), ("offset", offset)):
        if options.part == part:
            for phantom in options.phantom or PHANTOMS:
                row = cell(f"{part}/{phantom}/{name}", lambda p=phantom, m=measure: m(p, **scene))
                output.line(f"{part}: {row}")
    if options.part == "speed":
        for which in options.row or SPEED:
            output.line(f"{which}: {cell(f'speed/{which}', SPEED[which])}")
    if options.part == "page":
        joint_page.write(results.content)


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"joint.py: {error}")
