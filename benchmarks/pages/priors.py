"""What a volume is expected to look like: regularisers against total variation, on phantoms that suit it and that do not.

    python -m benchmarks.pages.priors oracle [--phantom atoms] [--noise clipped] [--size 64]   # true noise, best of the weights
    python -m benchmarks.pages.priors joint                                                    # as a user gets them
    python -m benchmarks.pages.priors page                                                     # priors.md from the JSON

Each row is saved when it is done, in results/priors.json in docs/benchmarks, and is not computed again without --again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import FOLDER, dots
from benchmarks.pages.joint_accuracy import NOISES, true_noise
from benchmarks.pages.prior_candidates import CANDIDATES
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, Scene, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from recon.joint.joint import JointReconstructor
from recon.metrics.metrics import compare

PHANTOMS = ("shells", "virions", "filaments", "particles", "slab", "atoms", "texture", "catalyst")
WEIGHTS = (0.2, 0.4, 0.8, 1.6)
_TIED = 0.002  # nats per pixel: about the standard error of a difference at 64³
_HEAD = """# Regularisers

![Gain of two regularisers over total variation, scene by scene](priors.png)

Directional total variation, the default, is more accurate than total variation in every scene but a slab of 48³. The tables show
volume PSNR in dB: that of total variation, and the gain of the others over it. Numbers in brackets are processor time as
a ratio to that of total variation.

Written by `python -m benchmarks.pages.priors page` from `results/priors.json`; each row is one command."""
_WHY = """## Why directional total variation is the default

A new default had to gain 0.5 dB in the mean of the joint fits of 25 scenes, lose more than 0.1 dB on no scene, and take at
most 1.5 times the time. Directional total variation satisfies all three conditions. It gains in every scene, under all five
noises, and also on textures, atoms and a porous catalyst. On a real needle it changes the PSNR of left-out tilts by -0.04,
+0.14, +0.20 and +0.71 dB, and increases their likelihood in all four cases. At half the resolution, where large volumes
start, total variation replaces it. At 512³ its gain is small, because a fit of 150 steps has not converged there: twice the
steps would gain 0.7 dB more.

| tried | why it is not the default |
|---|---|
| directional, in stages | the same, with normals from the fit's own earlier volume; the result depends on the number of steps |
| directional, discount 0.9 | 48³, two weights: filaments +0.9 dB, particles +1.2 dB, but slab -0.2 dB |
| normals from the structure tensor | 48³, two weights: shells +0.3 dB, particles +0.3 dB, but filaments -0.7 dB |
| second order | gains on shells, filaments, atoms and texture, but loses on particles and slab; `--regulariser second-order` |
| second order, c = 0.3 | loses less (7 scenes of 25 by more than 0.1 dB), but gains only +0.10 dB in the mean |
| Hessian–Schatten | 48³, two weights: shells +0.1 dB, slab -0.4 to -0.6 dB, filaments -2 dB, 3 to 5 times the time |
| reweighted TV, logarithm, non-local means | on shells, the fit returns to the volume before them, which held-out pixels prefer |
| grey levels | shells have many levels, and the slab loses 0.3 dB |
| TGV | no gain on shells, slab -0.5 dB, four to five times the time |
| network, tilts | Noise2Inverse on two halves of the tilts, trained once for four weights: loses 0.3 to 0.4 dB |
| group sparsity | loses on thin objects (filaments -0.61 dB with the true noise) |
| lower or higher cost of differences along z | a lower cost helps filaments and harms atoms; a higher cost does the opposite |
| TV + attenuation | the gain is within the spread of two fits (0.1 dB) |
| choice by held-out likelihood | in use for the second order, if it is better by one standard error; mostly it is not |

Denoisers enter by half-quadratic splitting, with half of total variation.

Not measured: a network trained on phantoms that no benchmark uses (`--regulariser "network, phantoms"`, which trains it
first), and BM4D, whose licence is non-commercial."""
_WORSE = 0.1  # dB that no scene may lose
Row = dict[str, Any]


def fitted(scene: Scene, make: Callable[[], JointReconstructor]) -> Row:
    """One fit: volume PSNR, held-out likelihood and processor time."""
    started = time.process_time()
    result = make()(scene.noisy)
    seconds = time.process_time() - started
    psnr = compare(result.volume.attenuation, scene.truth).psnr
    judged = None if result.fit_result is None else result.fit_result.held_out_nll
    return {"volume": psnr, "weight": result.weight, "held-out": judged, "seconds": seconds}


def oracle(scene: Scene, noise: str, name: str) -> Row:
    """The true noise and the best of the weights."""

    def fit(weight: float) -> Row:
        return fitted(
            scene,
            lambda: JointReconstructor(
                noise_model=lambda: true_noise(noise), weight=weight, regulariser=CANDIDATES[name](scene)
            ),
        )

    fits = [fit(weight) for weight in WEIGHTS]
    best = max(fits, key=lambda found: float(found["volume"]))
    return best | {"seconds": sum(found["seconds"] for found in fits) / len(fits)}


def joint(scene: Scene, noise: str, name: str) -> Row:
    """Noise and weight as the fit chooses them."""
    del noise
    return fitted(scene, lambda: JointReconstructor(regulariser=CANDIDATES[name](scene)))


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    lines, cells = [_HEAD, ""], content["cells"]
    for part, words in (
        ("oracle", "True noise, best of four weights"),
        ("earlier", "The same, with the fit of commits 72700d1 and 2e37b89"),
        ("joint", "Noise and weight chosen by the fit"),
    ):
        scenes: dict[str, dict[str, Row]] = {}
        for key, row in cells.items():
            kind, where, name = key.split("/", 2)
            if kind == part:
                scenes.setdefault(where, {})[name] = row
        names = [name for name in CANDIDATES if any(name in found for found in scenes.values())]
        if not names:
            continue
        lines += [f"## {words}", "", f"| scene | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
        lines += [
            f"| {where} | {' | '.join(_text(found, name) for name in names)} |" for where, found in scenes.items()
        ]
        gains = {
            name: [row[name]["volume"] - row[names[0]]["volume"] for row in scenes.values() if name in row]
            for name in names
        }
        means = [f"{sum(found) / len(found):+.2f} of {len(found)}" for found in gains.values()]
        lines += [f"| mean gain, number of scenes | {' | '.join(means)} |"]
        worse = [str(sum(gain < -_WORSE for gain in found)) for found in gains.values()]
        lines += [f"| worse by more than {_WORSE} dB | {' | '.join(worse)} |", ""]
        lines += _chosen(scenes) if part == "joint" else []
    return "\n".join([*lines, _WHY, "", measured_on([content]), ""])


def panel(cells: dict[str, Row]) -> dots.Panel:
    """Gains over total variation with noise and weight as the fit chooses them, the largest first."""
    gains: dict[str, dict[str, float]] = {"directional": {}, "second-order": {}}
    for key, row in cells.items():
        kind, where, name = key.split("/", 2)
        if kind == "joint" and name in gains:
            gains[name][where] = row["volume"] - cells[f"joint/{where}/total-variation"]["volume"]
    ranked = {
        name: dict(sorted(found.items(), key=lambda item: item[1], reverse=True)) for name, found in gains.items()
    }
    return "Noise and weight as the fit chooses them", "gain over total variation (dB)", ranked


def _text(found: dict[str, Row], name: str) -> str:
    row, first = found.get(name), found.get("total-variation")
    if row is None or first is None:
        return ""
    if row is first:
        return f"{row['volume']:.2f}"
    return f"{row['volume'] - first['volume']:+.2f} ({row['seconds'] / first['seconds']:.1f})"


def _chosen(scenes: dict[str, dict[str, Row]]) -> list[str]:
    """What choosing between two by held-out likelihood would gain, and the best that any choice could."""
    pairs = [(found["total-variation"], found["second-order"]) for found in scenes.values() if "second-order" in found]
    if not pairs:
        return []
    picked = [second if second["held-out"] < first["held-out"] - _TIED else first for first, second in pairs]
    gain = sum(row["volume"] - first["volume"] for row, (first, _) in zip(picked, pairs, strict=True)) / len(pairs)
    most = sum(max(0.0, second["volume"] - first["volume"]) for first, second in pairs) / len(pairs)
    cost = sum(first["seconds"] + second["seconds"] for first, second in pairs) / sum(
        first["seconds"] for first, _ in pairs
    )
    return [
        f"Choosing total variation or second order per series by held-out likelihood gains {gain:+.2f} dB in the mean of "
        f"{len(pairs)} scenes at {cost:.1f} times the time; the best choice of the two would gain {most:+.2f} dB.",
        "",
    ]


def main() -> None:
    """Run the chosen rows, save each, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("oracle", "joint", "page"))
    parser.add_argument("--phantom", action="append", choices=PHANTOMS)
    parser.add_argument("--noise", action="append", choices=NOISES)
    parser.add_argument("--regulariser", action="append", choices=list(CANDIDATES))
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--tilts", default="-59.5:57.5:1.5", help="START:STOP:STEP in degrees; 79 tilts by default")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "priors.json", help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results, output = Results(options.out, "priors"), Output(json_mode=False)
    if options.part == "page":
        with io.atomic_path(FOLDER / "priors.md") as partial:
            partial.write_text(page(results.content), encoding="utf-8")
        dots.save(FOLDER / "priors.png", [panel(results.cells)], columns=1)
        return
    compute = {"oracle": oracle, "joint": joint}[options.part]
    for noise in options.noise or NOISES:
        for phantom in options.phantom or PHANTOMS:
            for name in options.regulariser or CANDIDATES:
                key = f"{options.part}/{phantom}, {noise}, {options.size}³/{name}"
                if options.again:
                    results.cells.pop(key, None)
                scene = make_scene(options.size, phantom=phantom, noise=noise, tilts=options.tilts)
                row = results.cell(key, lambda s=scene, n=noise, r=name: compute(s, n, r))  # type: ignore[misc]
                output.line(f"{key}: {row}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"priors.py: {error}")
