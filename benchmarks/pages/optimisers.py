"""Volume PSNR against evaluations of the objective: the last stage of the joint fit by Adam and by L-BFGS, from the same state.

python -m benchmarks.pages.optimisers run [--only shells]    # scenes that are there are kept
python -m benchmarks.pages.optimisers page                   # optimisers.md from the JSON
"""

from __future__ import annotations

import argparse
import copy
import statistics
from typing import Any

import torch
from torch import Tensor

from benchmarks.pages import FOLDER
from benchmarks.pages.joint_accuracy import NOISES, PHANTOMS
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, make_scene
from noiseflow import FitResult
from noiseflow.fitting.steps import lbfgs
from noiseflow.io import atomic_path
from recon.joint.joint import JointReconstructor
from recon.joint.run import run_fit
from recon.metrics.metrics import compare

SIZE, TILTS, PAIRS = 48, "-58.5:58.5:3", 10
EVALUATIONS = (20, 40, 80)
SCENES = [f"{PHANTOMS[p]}/{NOISES[(p + k) % len(NOISES)]}" for k in range(len(NOISES)) for p in range(len(PHANTOMS))]
_HEAD = f"""# Optimisers of the volume

The volume is fitted by Adam on a sum of grids. Here noise model, weight and regulariser are those that the joint fit chose with
it, and the last stage of the volume is taken by L-BFGS on voxels instead ({PAIRS} pairs, strong Wolfe conditions; the detector
response is fixed), from the same state. Volume PSNR (dB), {SIZE}³ voxels, 40 tilts; *Adam* takes 75 steps.

```sh
python -m benchmarks.pages.optimisers run
```"""
_LIMITS = """L-BFGS throughout was given up: it converges further than Adam where the prior is weak, so that weights chosen at few
counts were unsteady, vacuum kept a haze, and the offset of clipped counts drifted. Each pair takes the memory of two volumes."""


def measure(name: str) -> dict[str, Any]:
    """PSNR of both optimisers after numbers of evaluations, and the mass of the volume relative to the truth."""
    phantom, noise = name.split("/")
    scene, row = make_scene(SIZE, phantom=phantom, noise=noise, tilts=TILTS), dict[str, Any]()

    def watched(stage: str, noise_model: Any, signal: Any, observation: Tensor, **given: Any) -> FitResult:
        if stage == "fit":
            start = copy.deepcopy(signal.state_dict())
            row.update(by_lbfgs(noise_model, signal, observation, ~given["held_out"], scene.truth))
            signal.load_state_dict(start)
        return run_fit(stage, noise_model, signal, observation, **given)

    volume = JointReconstructor(run_fit=watched)(scene.noisy).volume.attenuation
    row["Adam"] = compare(volume, scene.truth).psnr
    return row | {"Adam, mass": float(volume.sum() / scene.truth.sum())}


def by_lbfgs(noise_model: Any, signal: Any, observation: Tensor, train: Tensor, truth: Any) -> dict[str, float]:
    """The same for L-BFGS on the finest grid of a signal model, which is then changed."""
    signal.keep_slopes, signal.slope = False, None  # a line search needs the objective itself
    *coarse, finest = signal.field.grids
    for grid in coarse:
        grid.requires_grad_(False)
    optimiser = lbfgs([finest], max_iter=EVALUATIONS[-1], history_size=PAIRS)
    optimiser.param_groups[0].update(max_eval=EVALUATIONS[-1], tolerance_change=0, tolerance_grad=0)
    done, row = 0, dict[str, float]()

    def closure() -> Tensor:
        nonlocal done
        optimiser.zero_grad()
        log_prob = noise_model(signal.signal()).log_prob(observation.flatten())
        loss: Tensor = signal.penalty() - log_prob[train.flatten()].mean()
        loss.backward()  # type: ignore[no-untyped-call]
        done += 1
        if done in EVALUATIONS:
            volume = signal.volume().numpy()
            row[f"L-BFGS, {done}"] = compare(volume, truth).psnr
            row["L-BFGS, mass"] = float(volume.sum() / truth.sum())
        return loss

    optimiser.step(closure)  # type: ignore[arg-type]
    signal.keep_slopes = True
    for grid in coarse:
        grid.requires_grad_(True)
    return row


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    columns = ["Adam", *(f"L-BFGS, {count}" for count in EVALUATIONS)]
    masses = ["Adam, mass", "L-BFGS, mass"]
    rows = [
        [*name.split("/"), *(f"{row[each]:.2f}" for each in columns), *(f"{row[each]:.3f}" for each in masses)]
        for name, row in content["cells"].items()
    ]
    gains = [[row[each] - row["Adam"] for row in content["cells"].values()] for each in columns[1:]]
    words = (
        f"- {each} evaluations: {statistics.mean(gain):+.2f} dB in the mean, {min(gain):+.2f} to {max(gain):+.2f} dB"
        for each, gain in zip(columns[1:], gains, strict=True)
    )
    figures = table(["phantom", "noise", *columns, *masses], rows)
    return "\n\n".join([_HEAD, "\n".join(words), figures, _LIMITS, measured_on([content])]) + "\n"


def main() -> None:
    """Run the scenes and save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--only", default="", help="scenes whose name contains this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = Results(FOLDER / "results" / "optimisers.json", "optimisers")
    if options.part == "run":
        for name in SCENES:
            if options.only in name:
                results.cell(name, lambda name=name: measure(name))  # type: ignore[misc]
        return
    with atomic_path(FOLDER / "optimisers.md") as partial:
        partial.write_text(page(results.content), encoding="utf-8")


if __name__ == "__main__":
    main()
