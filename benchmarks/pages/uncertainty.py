"""Error bars of a volume: how many voxels their intervals cover, on scenes of known truth, and what they cost.

    python -m benchmarks.pages.uncertainty coverage [--phantom shells] [--noise clipped] [--size 96]     # 25 rows
    python -m benchmarks.pages.uncertainty independent                     # scenes of tests/independent_scenes.py
    python -m benchmarks.pages.uncertainty left-out [--phantom shells]     # tilts that no fit saw, right and wrong noise model
    python -m benchmarks.pages.uncertainty needle                          # the same of the shipped needle
    python -m benchmarks.pages.uncertainty page                            # uncertainty.md from the JSON

Each row is saved when it is done, in results/uncertainty.json in docs/benchmarks, and is not computed again without --again.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from benchmarks.coverage import left_out_ranks, share_within, unseen_part, voxel_coverage
from benchmarks.needle import load as load_needle
from benchmarks.pages import FOLDER
from benchmarks.pages.joint_accuracy import NOISES, PHANTOMS, true_noise
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from noiseflow.metrics.evaluation import kolmogorov_smirnov
from noiseflow.report.charts import new_figure, show_image
from recon.methods import reconstruct
from recon.metrics.metrics import compare
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.uncertainty import Uncertainty, error_bars
from tests.independent_scenes import SCENES, independent_series

_SECTIONS = FOLDER / "results" / "uncertainty_sections"  # (volume, std, truth), z by x through the middle
_OCCUPIED = 0.05  # of the largest attenuation: below that a voxel counts as vacuum
_HEAD = """# Error bars: do they contain the truth?

![volume, standard deviation, true error](uncertainty.png)

*Volume, width of the intervals (one standard deviation) and true error of five phantoms with clipped noise, slices (z, x)
through the middle.*

The 90 % interval is the volume ± 1.645·√(std² + bias² + wedge²). `std` and `bias` come from Langevin samples of the
posterior: the learnt likelihood times the prior that regulariser and weight define. `wedge` estimates the error at the
frequencies that no tilt recorded. There the samples have 0.3 to 6 times the power of the error (20 scenes; twice in the
median), but spread it evenly over the object, so that its edges have too little. The map places this power where the
volume has detail at the frequencies beside the wedge, and gives no voxel more than this detail.

Written by `python -m benchmarks.pages.uncertainty page` from `results/uncertainty.json`; each row is one command."""
_WHY = """
- **The map of the wedge** widens intervals where they were too narrow (beads: 76 % without it, 87 % with it), and also
  where they were wide enough, because the samples keep their own spread in the wedge (column *without wedge*).
- **Coverage above 95 %** (particles, slabs, smooth objects): the intervals are too wide. A likely cause: the most probable
  volume of objects with flat faces errs less than draws from the posterior do, whose spread the intervals describe.
- **Coverage below 85 %**: a thin film across the missing directions (faceted particle) vanishes from the volume and
  leaves no detail beside the wedge, so that no map shows it; an object at the edge of the field (off axis) has its error
  at faces that the vacuum cuts off; thin fibres are lowered by the regulariser.
- **Blocks of slices** give the same spread as a whole fit under one noise model (a mean of 0.998 to 1.001 times, 40³,
  blocks of 20 and of 10). If the noise model is chosen anew, blocks choose it on another slab, and the spread differs
  accordingly.
- **Limits**: error bars take noise model and weight as given. They do not reveal a badly chosen weight (8-bit particles
  fitted at commit 924b6ea with weight 0.006 in place of 1.1: 54 % covered).
- **Time**: the last column is a ratio of processor times. The machine had other work; ratios of an idle one are lower.

In the table, *occupied voxels* and *vacuum* are the shares of voxels whose interval contains the truth, *inside* that of
occupied voxels whose neighbours are occupied, *truth above* and *truth below* the shares of occupied voxels outside the
interval, and *wider by* is the factor on the half-width at which 90 % of the occupied voxels
would be covered. The last column is the time of the error bars over that of the fit. Rows with counts are scenes
of `tests/independent_scenes.py`, which share no code with the library. The formula was chosen with these scenes and the
phantoms in view; the needle was not.

On the real needle with tilts to ±60°, the volume from all tilts to ±90° is a reference: its voxels outside the object are
in 72.7 % of the intervals without the map and in 99.6 % with it, those of the object in 97.8 and 98.3 %."""
_LEFT_OUT = """The table shows the share of pixels of left-out tilts inside the 90 % interval and, in brackets, the largest
distance of the distribution of the ranks from the uniform one. Goal: 87 to 93 % of the pixels, and uniform ranks.

For clipped pixels, the intervals of a Gaussian contain the right share by chance. The ranks show that it is wrong: their
distance is below 0.02 under the right kind of noise, and 0.16 and more under a Gaussian.

On the real needle the intervals contain the right share (98.2 % before the noise model that describes a quiet series was
fitted to the end, 96.8 % with total variation), but the ranks are not uniform:

- The residuals of a quiet series are misfit more than noise. They have structure, and ranks need not be uniform under any
  noise model.
- A quiet series is fitted and sampled by least squares, with one width for all pixels, although the residuals are about
  thirty times smaller where the sample is dark.
- No error bar covers misalignment.

The program warns that the error bars of a quiet series cannot be relied on."""
_LOW, _NOMINAL, _HIGH = 0.85, 0.9, 0.95
_ONE_SIGMA = 0.6827
_INDEPENDENT = (("Poisson 100", "±60°/2°"), ("Poisson 40, read noise", "±70°/5°"), ("Poisson 100", "±50°/10°"))
_INDEPENDENT_SIZE = 40
_GAP = 8  # every eighth tilt is left out
Row = dict[str, Any]


def coverage(phantom: str, noise: str, *, size: int, tilts: str, samples: int) -> Row:
    """One row: the joint fit as a user gets it, its error bars, and the share of voxels whose interval holds the truth."""
    scene = make_scene(size, phantom=phantom, noise=noise, tilts=tilts)
    row, volume, bars = _covered(scene.noisy, scene.truth, samples)
    truth = scene.truth
    if noise == "clipped":
        middle = truth.shape[1] // 2
        width = bars.half_width(_ONE_SIGMA)
        planes = {"volume": volume[:, middle], "std": width[:, middle], "truth": truth[:, middle]}
        _SECTIONS.mkdir(parents=True, exist_ok=True)
        io.write(_SECTIONS / f"{phantom}.npy", np.stack(list(planes.values())).astype(np.float32))
    return {"phantom": phantom, "noise": noise, "size": size, **row}


def independent(scene: str, noise: str, tilts: str, *, size: int, samples: int) -> Row:
    """One row of a scene that shares no code with the library."""
    made = independent_series(scene, noise, tilts, size=size)
    row, _, _ = _covered(made.series, made.truth, samples)
    return {"phantom": scene.replace("_", " "), "noise": f"{noise}, {tilts}", "size": size, **row}


def _covered(series: TiltSeries, truth: NDArray[Any], samples: int) -> tuple[Row, NDArray[Any], Uncertainty]:
    started = time.process_time()
    result = reconstruct(series, VolumeGrid.of(series, truth.shape[0]), method="joint")
    fitted = time.process_time()
    bars = error_bars(result, series, samples)
    done = time.process_time()
    volume = result.volume.attenuation
    occupied = truth > _OCCUPIED * truth.max()
    covered = voxel_coverage(volume, bars, truth)
    without = replace(bars, wedge=replace(bars.wedge, attenuation=0 * volume))
    inside = (truth[occupied] - volume[occupied]) / np.maximum(bars.half_width()[occupied], 1e-12)
    row = {
        "volume": compare(volume, truth).psnr,
        "occupied covered": covered[occupied].mean(),
        "covered without wedge": voxel_coverage(volume, without, truth)[occupied].mean(),
        "inside covered": covered[binary_erosion(occupied)].mean(),
        "vacuum covered": covered[~occupied].mean(),
        "too low": (inside > 1).mean(),
        "too high": (inside < -1).mean(),
        "widening": np.quantile(np.abs(inside), 0.9),
        "error unseen": np.square(unseen_part(volume - truth, series.tilt_angles)).sum()
        / np.square(volume - truth).sum(),
        "seconds, fit": fitted - started,
        "seconds, error bars": done - fitted,
    }
    return row, volume, bars


def left_out(phantom: str, *, noise: str = "clipped", size: int, tilts: str, samples: int) -> Row:
    """One row: how many pixels of every eighth tilt, left out, the 90 % interval of the predictive distribution holds."""
    series = make_scene(size, phantom=phantom, noise=noise, tilts=tilts).noisy
    settings: dict[str, Row] = {"learnt": {"method": "joint"}, "Gaussian": {"method": "l2"}}
    settings["true"] = {"method": "joint", "noise_model": true_noise(noise)}
    return {"phantom": phantom, "noise": noise, **_judged(series, settings, samples)}


def needle(*, samples: int) -> Row:
    """One row: the same of the shipped needle, whose noise nobody knows."""
    settings: dict[str, Row] = {"learnt": {"method": "joint"}, "Gaussian": {"method": "l2"}}
    return {"phantom": "needle (real)", "noise": "as measured", **_judged(load_needle(), settings, samples)}


def _judged(series: TiltSeries, settings: dict[str, Row], samples: int) -> Row:
    row = {}
    for name, options in settings.items():
        ranks = left_out_ranks(series, every=_GAP, num_samples=samples, **options)
        row[name] = {"covered": share_within(ranks), "distance": kolmogorov_smirnov(ranks.ravel())}
    return row


def draw() -> Figure:
    """Volume, width of the intervals and true error of every phantom with clipped noise, (z, x) through the middle."""
    paths = [path for phantom in PHANTOMS if (path := _SECTIONS / f"{phantom}.npy").exists()]
    figure, axes = new_figure(3, max(1, len(paths)), width=7.5, height=2.3)
    for row, path in zip(axes, paths, strict=False):
        volume, std, truth = np.load(path)
        reach = float(max(np.percentile(std, 99.5), np.percentile(np.abs(volume - truth), 99.5)))
        row[0].set_ylabel(path.stem)
        show_image(row[0], volume, "volume", limits=(0.0, float(truth.max())))
        show_image(row[1], std, "√(std² + bias² + wedge²)", limits=(0.0, reach))
        show_image(row[2], np.abs(volume - truth), "|volume − truth|", limits=(0.0, reach))
    return figure


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells: dict[str, Row] = content["cells"]
    rows = [row for key, row in cells.items() if key.startswith(("coverage/", "independent/"))]
    with_map, without = (
        f"{sum(_LOW <= share <= _HIGH for share in shares)} of {len(shares)} scenes, below in "
        f"{sum(share < _LOW for share in shares)}, above in {sum(share > _HIGH for share in shares)}; its mean distance from "
        f"90 % is {100 * np.abs(np.array(shares) - _NOMINAL).mean():.1f} points"
        for shares in ([row[name] for row in rows] for name in ("occupied covered", "covered without wedge"))
    )
    lines = [_HEAD, "", "## With the truth", ""]
    lines += [
        f"The coverage is within 85 to 95 % in {with_map}.",
        f"Without the map of the wedge: {without}.",
        _WHY,
        "",
    ]
    lines += [
        "| phantom | noise | size | volume, dB | occupied voxels | without wedge | inside | truth above | truth below | vacuum "
        "| wider by | error unseen | error bars : fit |"
    ]
    lines += ["|---" * 13 + "|"]
    for row in rows:
        names = ("occupied covered", "covered without wedge", "inside covered", "too low", "too high", "vacuum covered")
        shares = [f"{100 * row[name]:.{2 if name == 'vacuum covered' else 1}f} %" for name in names]
        ratio = row["seconds, error bars"] / row["seconds, fit"]
        ends = [f"{row['widening']:.2f} ×", f"{100 * row['error unseen']:.0f} %", f"{ratio:.2f}"]
        start = [row["phantom"], row["noise"], f"{row['size']}³", f"{row['volume']:.2f}"]
        lines.append(f"| {' | '.join(start + shares + ends)} |")
    rows = [row for key, row in cells.items() if key.startswith("left-out/")]
    if rows:
        lines += [
            "",
            "## Tilts left out",
            "",
            _LEFT_OUT,
            "",
            "| phantom | noise | learnt | true | Gaussian (wrong) |",
            "|---|---|---|---|---|",
        ]
        for row in rows:
            shares = [
                f"{100 * row[name]['covered']:.1f} % ({row[name]['distance']:.3f})" if name in row else "unknown"
                for name in ("learnt", "true", "Gaussian")
            ]
            lines.append(f"| {row['phantom']} | {row['noise']} | {' | '.join(shares)} |")
    return "\n".join([*lines, "", measured_on([content]), ""])


def main() -> None:
    """Run the chosen rows, save each, and draw the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("coverage", "independent", "left-out", "needle", "page"))
    parser.add_argument("--phantom", action="append", choices=PHANTOMS)
    parser.add_argument("--noise", action="append", choices=NOISES)
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--tilts", default="-59.5:57.5:1.5", help="START:STOP:STEP in degrees; 79 tilts by default")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "uncertainty.json", help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results, output = Results(options.out, "error bars"), Output(json_mode=False)
    scene = {"size": options.size, "tilts": options.tilts, "samples": options.samples}

    def cell(key: str, compute: Callable[[], Row]) -> None:
        if options.again:
            results.cells.pop(key, None)
        output.line(f"{key}: {results.cell(key, compute)}")

    where = f"{options.size}/{options.tilts}/{options.samples}"
    for phantom in options.phantom or PHANTOMS:
        if options.part == "left-out":
            cell(f"left-out/{phantom}/{where}", lambda p=phantom: left_out(p, **scene))
        if options.part == "coverage":
            for noise in options.noise or NOISES:
                cell(f"coverage/{phantom}/{noise}/{where}", lambda p=phantom, n=noise: coverage(p, n, **scene))
    if options.part == "independent":
        settings = {"size": _INDEPENDENT_SIZE, "samples": options.samples}
        for scene_name, (noise, tilts) in zip(SCENES, itertools.cycle(_INDEPENDENT), strict=False):
            key = f"independent/{scene_name}/{noise}/{tilts}/{_INDEPENDENT_SIZE}/{options.samples}"
            cell(key, lambda s=scene_name, n=noise, t=tilts: independent(s, n, t, **settings))
    if options.part == "needle":
        cell("left-out/needle", lambda: needle(samples=options.samples))
    if options.part == "page":
        draw().savefig(FOLDER / "uncertainty.png", dpi=90)
        with io.atomic_path(FOLDER / "uncertainty.md") as partial:
            partial.write_text(page(results.content), encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"uncertainty.py: {error}")
