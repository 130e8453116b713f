"""Volume PSNR against evaluations of the objective, by optimiser, with known noise.

python -m benchmarks.pages.optimisers     # optimisers.md and its JSON, in less than three minutes on two idle cores
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from benchmarks.pages import FOLDER
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, Scene, make_scene
from noiseflow.io import atomic_path
from recon.fields.kinds.grids import MultiresolutionField
from recon.fields.kinds.voxels import VoxelField
from recon.joint.joint import JointReconstructor
from recon.metrics.metrics import compare

SIZE, TILTS, EVALUATIONS = 32, "-58.5:58.5:3", (20, 40, 80, 160)
SCENES = {
    "shells, clipped": ("shells", "clipped", 0.4),
    "shells, outliers": ("shells", "outliers", 0.4),
    "filaments, clipped": ("filaments", "clipped", 0.25),
    "slab, clipped": ("slab", "clipped", 0.4),
    "particles, low dose": ("particles", "low-dose", 0.8),
}
"""Name → phantom, noise, weight."""


_HEAD = f"""# Optimisers of the volume

The volume is fitted by L-BFGS on the sum of grids (`noiseflow.fitting.quasi_newton`), one gradient per step, with a smooth
positive map and no learning rate. Adam, which fits networks and Gaussians, is shown with its decay over the given number of
evaluations.

Volume PSNR (dB), {SIZE}³ voxels, 40 tilts, true noise, fixed weight; one fit each, a quarter of it by least squares. Two
fits of a scene differ by 0.1 dB.

```sh
python -m benchmarks.pages.optimisers
```"""
_LIMITS = """The objective is not convex, and long fits at the weight of short ones follow noise (*shells, outliers*). The
likelihood of held-out pixels, which also chooses the weight, stops them."""


class AdamGrids(MultiresolutionField):
    """The sum of grids, fitted by Adam."""

    quasi_newton = False

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.grids), "lr": 1.0, "eps": 1e-15}]


FITS: dict[str, Callable[..., MultiresolutionField]] = {
    "L-BFGS, sum of grids": MultiresolutionField,
    "L-BFGS, voxels": VoxelField,
    "Adam, sum of grids": AdamGrids,
}


def measure(
    scene: Scene, field: Callable[..., MultiresolutionField], weight: float, evaluations: int
) -> dict[str, Any]:
    """PSNR of the volume and seconds of one fit; without half resolution, because only large volumes use it."""
    fit = JointReconstructor(
        weight=weight, noise_model=lambda: scene.noise_model, make_field=field, num_steps=evaluations
    )
    started = time.perf_counter()
    found = fit(scene.noisy)
    return {"seconds": time.perf_counter() - started, "psnr": compare(found.volume.attenuation, scene.truth).psnr}


def page(cells: dict[str, dict[str, Any]], place: str) -> str:
    """The page as Markdown."""
    header = ["scene", "optimiser", *(f"{count} evaluations" for count in EVALUATIONS), "seconds of the last"]
    rows = []
    for scene in SCENES:
        for name in FITS:
            found = [cells[f"{scene}/{name}/{count}"] for count in EVALUATIONS]
            rows.append([scene, name, *(f"{each['psnr']:.2f}" for each in found), f"{found[-1]['seconds']:.1f}"])
    return "\n\n".join([_HEAD, table(header, rows), _LIMITS, place]) + "\n"


def main() -> None:
    """Measure rows that are not there yet, and write the page."""
    results = Results(FOLDER / "results" / "optimisers.json", "optimisers")
    for scene_name, (phantom, noise, weight) in SCENES.items():
        scene = make_scene(SIZE, phantom=phantom, noise=noise, tilts=TILTS)
        for name, field in FITS.items():
            for count in EVALUATIONS:
                results.cell(f"{scene_name}/{name}/{count}", lambda f=field, c=count: measure(scene, f, weight, c))  # type: ignore[misc]  # noqa: B023
    with atomic_path(FOLDER / "optimisers.md") as partial:
        partial.write_text(page(results.cells, measured_on([results.content])), encoding="utf-8")


if __name__ == "__main__":
    main()
