"""The main table of Kniesel et al. (CVPR 2022, doi:10.1109/CVPR52688.2022.02018), repeated on a scene with known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import nn

from benchmarks.external import missing
from benchmarks.scenes import EMPTY, Cell, Results, Scene
from benchmarks.search import (
    FIRST_WEIGHT,
    STEPS,
    Array,
    Best,
    back_projections,
    best,
    best_fit,
    denoised,
    empty_volume,
    sirts,
)
from noiseflow import Digitised, Gaussian, SplineFlow, detect_digitisation, fit
from recon.fields.kinds.network import CoordinateNetwork
from recon.methods.kniesel2022 import PRESETS
from recon.metrics.metrics import compare
from recon.series.tilt_series import TiltSeries

PUBLISHED: dict[str, tuple[float, float, float, float, float]] = {
    "WBP": (2.97, 50.901, 4.904, 7.62, 17.299),
    "SIRT": (3.27, 47.622, 4.832, 9.13, 12.223),
    "L2, noisy images": (13.86, 4.271, 1.885, 19.73, 1.064),
    "L2, denoised images": (18.15, 1.544, 0.849, 20.25, 0.944),
    "joint": (19.93, 1.020, 0.645, 21.75, 0.669),
    "joint, supervised": (20.07, 0.991, 0.636, 20.64, 0.864),
    "L2, clean images": (20.73, 0.840, 0.393, 21.60, 0.691),
}
"""2D PSNR (dB), 100·MSE and 10·DSSIM, 3D PSNR and 100·MSE, as printed, except that MSE and DSSIM of the last five rows are
exchanged: in print their columns are swapped (10·log10 of the printed DSSIM/100 is the printed PSNR)."""

CLEAN_STEPS = 4 * STEPS  # without noise a fit improves for much longer
_NETWORK, _OF_THE_PAPER = ", network", ", network of the paper"
"""Ends of the names of rows whose volume is a sine network, or the network of the paper, in place of grids."""
NOT_RUN = {
    "joint + network of the paper": "steps by the likelihood of its flow, which has no bound at clipped values, made the volume "
    "worse; the volume of the preset `kniesel2022` is that of *L2, noisy images, network of the paper*",
    "L2, clean images"
    + _NETWORK: f"at 96³, its {CLEAN_STEPS} steps of a network, four times those of the rows beside it, take "
    "about two hours on two cores",
}
"""Rows that were not run, or not at every size, with the reason."""
_CLEAN = 0.02  # initial weight of the search for data without noise


def run(scene: Scene, results: Results, line: Callable[[str], None]) -> None:
    """Compute the result of each method of the table, those with networks last; existing results are kept."""
    methods = _methods(scene) | _with_network(scene, results) | _with_network_of_the_paper(scene)
    for name, method in methods.items():
        cell = results.cell(name, lambda m=method: _judged(scene, m()))  # type: ignore[misc]
        line(f"  {name}: 2D {cell['2d psnr min-max']:.2f} dB, 3D {cell['psnr min-max']:.2f} dB ({cell['setting']})")


def _methods(scene: Scene) -> dict[str, Callable[[], Best]]:
    noisy, grid, score = scene.noisy, scene.grid, _score(scene)

    def searched(series: TiltSeries, name: str, first: float = FIRST_WEIGHT) -> Best:
        return best_fit(series, grid, scene.joint(**_OPTIONS[name](scene)), score, first=first)

    def cleaned() -> Best:
        found = searched(_cleaned(noisy), "L2, denoised images")
        return Best(f"{_denoiser()}, {found.setting}", found.volume, found.tried)

    return {
        EMPTY: lambda: empty_volume(scene),
        "WBP": lambda: best(back_projections(noisy, grid), score),
        "SIRT": lambda: best(sirts(noisy, grid), score),
        "L2, noisy images": lambda: searched(noisy, "L2, noisy images"),
        "L2, denoised images": cleaned,
        "L2, clean images": lambda: searched(scene.clean, "L2, clean images", first=_CLEAN),
        "oracle": lambda: searched(noisy, "oracle"),
        "joint, supervised": lambda: _joint(scene, "joint, supervised"),
        "joint": lambda: _joint(scene, "joint"),
    }


_OPTIONS: dict[str, Callable[[Scene], dict[str, Any]]] = {
    "L2, noisy images": lambda scene: {"noise_model": Gaussian, "num_steps": STEPS},
    "L2, denoised images": lambda scene: {"noise_model": Gaussian, "num_steps": STEPS},
    "L2, clean images": lambda scene: {"noise_model": Gaussian, "num_steps": CLEAN_STEPS},
    "oracle": lambda scene: {"noise_model": lambda: scene.noise_model, "num_steps": STEPS},
    "joint, supervised": lambda scene: {"noise_model": lambda: calibrated(scene)},
    "joint": lambda scene: {},
}
"""Options of the joint fit of the fitted rows."""


METHODS = (
    *PUBLISHED,
    "oracle",
    *(name + _NETWORK for name in _OPTIONS),
    *(name + _OF_THE_PAPER for name in _OPTIONS if name.startswith("L2")),
    EMPTY,
)


def _joint(scene: Scene, name: str, **options: Any) -> Best:
    result = scene.joint(**_OPTIONS[name](scene), **options)(scene.noisy)
    return Best(f"chose weight {result.weight:.3g}", result.volume.attenuation, {})


def _series(scene: Scene, name: str) -> TiltSeries:
    """The series that a row reconstructs."""
    if "denoised" in name:
        return _cleaned(scene.noisy)
    return scene.clean if "clean" in name else scene.noisy


def _with_network(scene: Scene, results: Results) -> dict[str, Callable[[], Best]]:
    """The fitted rows with a sine network, at 0.7 of the weight that was best with grids, as the product chooses it."""

    def fitted(name: str) -> Best:
        if name.startswith("joint"):
            return _joint(scene, name, make_field=CoordinateNetwork)
        weight = CoordinateNetwork.relative_weight * float(results.cells[name]["setting"].rpartition("weight ")[2])
        fit = scene.joint(**_OPTIONS[name](scene), make_field=CoordinateNetwork, weight=weight)
        return Best(f"weight {weight:.3g}", fit(_series(scene, name), scene.grid).volume.attenuation, {})

    return {name + _NETWORK: partial(fitted, name) for name in _OPTIONS}


def _with_network_of_the_paper(scene: Scene) -> dict[str, Callable[[], Best]]:
    """The rows of least squares with the preset `kniesel2022`, to its end."""
    names = [name for name in _OPTIONS if name.startswith("L2")]
    return {name + _OF_THE_PAPER: lambda n=name: _trained(scene, n) for name in names}  # type: ignore[misc]


def _score(scene: Scene) -> Callable[[Array], float]:
    return lambda volume: compare(volume, scene.truth, scaling="affine").psnr


def _denoiser() -> str:
    return "nlm" if missing("bm3d") else "bm3d"


def _cleaned(series: TiltSeries) -> TiltSeries:
    return denoised(series, _denoiser())


def _trained(scene: Scene, name: str) -> Best:
    *_, state = replace(PRESETS["kniesel2022"], device=scene.device).train(_series(scene, name), scene.grid)
    return Best(f"{state.done} steps", state.volume(), {})


def calibrated(scene: Scene, *, seed: int = 0) -> nn.Module:
    """A flow fitted to clean and noisy images of the scene, as a calibration would give it."""
    digitisation = detect_digitisation(scene.noisy.images)
    flow: nn.Module = SplineFlow(mean_preserving=True)
    model = Digitised(flow, *digitisation) if digitisation.found else flow
    signal, observation = (torch.from_numpy(series.images).float() for series in (scene.clean, scene.noisy))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        fit(model, signal, observation, digitise=False, num_steps=400, generator=generator)
    return model.requires_grad_(False)


def _judged(scene: Scene, found: Best) -> Cell:
    setting = {"setting": found.setting, "tried": found.tried, "at an end": found.at_an_end}
    return setting | scene.errors(found.volume) | scene.projection_errors(found.volume)


def table(cells: dict[str, Cell]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows: our values with min–max scaling as in the paper, the published values, and ours affinely matched."""
    figures = ("2D PSNR", "2D MSE", "2D DSSIM", "3D PSNR", "3D MSE")
    published = (f"{name}, published" for name in figures)
    header = ("method", *figures, *published, "2D PSNR, affine", "3D PSNR, affine", "best setting")
    rows: list[tuple[str, ...]] = []
    for name in METHODS:
        if name in cells:
            theirs = PUBLISHED.get(name.removesuffix(_NETWORK).removesuffix(_OF_THE_PAPER))
            printed = ("–",) * 5 if theirs is None else tuple(f"{value:g}" for value in theirs)
            rows.append((name, *_figures(cells[name]), *printed, *_affine(cells[name]), str(cells[name]["setting"])))
    return header, rows


def _figures(cell: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{cell['2d psnr min-max']:.2f}",
        f"{100 * cell['2d mse min-max']:.3f}",
        f"{10 * cell['2d dssim min-max']:.3f}",
        f"{cell['psnr min-max']:.2f}",
        f"{100 * cell['mse min-max']:.3f}",
    )


def _affine(cell: dict[str, Any]) -> tuple[str, ...]:
    return f"{cell['2d psnr affine']:.2f}", f"{cell['psnr affine']:.2f}"
