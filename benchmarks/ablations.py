"""Ablations of the reconstruction: one change at a time on a scene with known ground truth."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import nn

from benchmarks.defocus import STRENGTH, defocused_scene
from benchmarks.external import missing
from benchmarks.network import WIDTHS, fit_network
from benchmarks.scenes import EMPTY, Cell, Results, Scene
from benchmarks.search import STEPS, Array, Best, back_projections, best, best_fit, denoised, empty_volume
from noiseflow import Digitised, Gaussian, RadialFlow, detect_digitisation
from recon.fields.fields import Field
from recon.fields.kinds.gaussians import GaussianField
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.fields.kinds.network import CoordinateNetwork
from recon.joint.run import RunFit, run_fit
from recon.methods.joint import Laplace
from recon.metrics.metrics import compare
from recon.projection.defocused_projector import KERNELS

WEIGHT = 0.4
"""Weight of the total variation in groups where it is the same for all variants."""

OF_NETWORKS = 32
"""Largest scene for the networks of several widths on a processor; a larger one takes hours."""
DENOISERS = ("nlm", "tv", "wavelet", "wiener", "bm3d")


@dataclass(frozen=True)
class Variant:
    """One row of the table: its group, its name, and a function that computes its volume."""

    group: str
    name: str
    make: Callable[[], Best]
    scene: Scene


def run(scene: Scene, results: Results, line: Callable[[str], None], *, quick: bool, small: Scene) -> None:
    """Compute the result of each variant; existing results are kept.

    Args:
        scene: scene of most groups.
        results: file of the results.
        line: called with progress messages.
        quick: compute only the first groups.
        small: scene for the coordinate networks, which are slow.
    """
    for group in GROUPS[:1] if quick else GROUPS:
        fill(group(scene), results, line)
    if not quick:
        fill(_networks(small), results, line)


def fill(variants: list[Variant], results: Results, line: Callable[[str], None]) -> None:
    """Compute the result of each of these variants."""
    for variant in variants:
        cell = results.cell(f"{variant.group}/{variant.name}", lambda v=variant: _judged(v))  # type: ignore[misc]
        line(f"  {variant.group}: {variant.name}: {cell['psnr raw']:.2f} dB, 2D {cell['2d psnr raw']:.2f} dB")


def _judged(variant: Variant) -> Cell:
    started = time.perf_counter()
    found = variant.make()
    seconds = time.perf_counter() - started
    about = {"setting": found.setting, "tried": found.tried, "seconds": seconds, "scene": variant.scene.name}
    return about | variant.scene.errors(found.volume) | variant.scene.projection_errors(found.volume)


def _score(scene: Scene) -> Callable[[Array], float]:
    return lambda volume: compare(volume, scene.truth).psnr


def _searched(scene: Scene, **options: Any) -> Best:
    return best_fit(scene.noisy, scene.grid, scene.joint(num_steps=STEPS, **options), _score(scene))


def _once(scene: Scene, **options: Any) -> Best:
    result = scene.joint(**options)(scene.noisy, scene.grid)
    return Best(f"weight {result.weight:.3g}", result.volume.attenuation, {})


def _likelihoods(scene: Scene) -> list[Variant]:
    variants: dict[str, Callable[[], Best]] = {
        EMPTY: lambda: empty_volume(scene),
        "L1": lambda: _searched(scene, noise_model=Laplace),
        "L2": lambda: _searched(scene, noise_model=Gaussian),
        "true noise (oracle)": lambda: _searched(scene, noise_model=lambda: scene.noise_model),
        "learnt noise (joint)": lambda: _once(scene),
    }
    return [Variant("likelihood", name, make, scene) for name, make in variants.items()]


def _denoisers(scene: Scene) -> list[Variant]:
    found = []
    for denoiser in ("none", *DENOISERS):
        if denoiser == "bm3d" and missing("bm3d"):
            continue

        def series(name: str = denoiser) -> Any:
            return scene.noisy if name == "none" else denoised(scene.noisy, name)

        def back_projected(series: Callable[[], Any] = series) -> Best:
            return best(
                back_projections(series(), scene.grid), lambda v: compare(v, scene.truth, scaling="affine").psnr
            )

        def least_squares(series: Callable[[], Any] = series) -> Best:
            return best_fit(series(), scene.grid, scene.joint(noise_model=Gaussian, num_steps=STEPS), _score(scene))

        found.append(Variant("denoiser, then WBP", denoiser, back_projected, scene))
        found.append(Variant("denoiser, then L2", denoiser, least_squares, scene))
    return found


_FIELDS: dict[str, type[Field]] = {
    "voxels": VoxelField,
    "sum of grids": MultiresolutionField,
    "Gaussians": GaussianField,
    "network": CoordinateNetwork,
}


def _fields(scene: Scene) -> list[Variant]:
    found = []
    for field_name, field in _FIELDS.items():
        variants: dict[str, Callable[[], Best]] = {
            "L2, no TV": partial(_once, scene, noise_model=Gaussian, make_field=field, weight=0.0, num_steps=STEPS),
            "L2, TV": partial(_searched, scene, noise_model=Gaussian, make_field=field),
            "noise model, no TV": partial(_once, scene, make_field=field, weight=0.0, num_steps=STEPS),
            "noise model, TV": partial(_once, scene, make_field=field, num_steps=STEPS),
        }
        found += [Variant("field", f"{field_name}, {name}", make, scene) for name, make in variants.items()]
    return found


def _flow(scene: Scene, layers: int = 8, *, mean_preserving: bool = True, digitised: bool = True) -> nn.Module:
    flow: nn.Module = RadialFlow(layers, mean_preserving=mean_preserving)
    digitisation = detect_digitisation(scene.noisy.images)
    return Digitised(flow, *digitisation) if digitised and digitisation.found else flow


def _with_flow(scene: Scene, run_fit: RunFit = run_fit, **options: Any) -> Best:
    return _once(scene, noise_model=partial(_flow, scene, **options), weight=WEIGHT, run_fit=run_fit)


def _layers(scene: Scene) -> list[Variant]:
    return [
        Variant("flow layers", str(layers), partial(_with_flow, scene, layers=layers), scene)
        for layers in (2, 4, 8, 16)
    ]


def _parts(scene: Scene) -> list[Variant]:
    variants: dict[str, Callable[[], Best]] = {
        "as it is": partial(_with_flow, scene),
        "mean not preserved": partial(_with_flow, scene, mean_preserving=False),
        "clipping ignored": partial(_with_flow, scene, digitised=False),
        "likelihood not tabulated": partial(_with_flow, scene, run_fit=partial(run_fit, tabulate=False)),
    }
    return [Variant("parts", name, make, scene) for name, make in variants.items()]


def _weights(scene: Scene) -> list[Variant]:
    return [
        Variant("weight", f"{weight:g}", partial(_once, scene, weight=weight), scene)
        for weight in (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2)
    ]


def _defocus(scene: Scene) -> list[Variant]:
    def fitted(blur: str, **options: Any) -> Best:
        return _once(defocused_scene(scene, kernel=blur), weight=WEIGHT, **options)

    ways: dict[str, dict[str, Any]] = {"not modelled": {"defocus": 0.0}}
    ways |= {f"modelled by {kernel}": {"defocus": STRENGTH, "defocus_kernel": kernel} for kernel in KERNELS}
    return [
        Variant("defocus", f"blurred by {blur}, {way}", partial(fitted, blur, **options), scene)
        for blur in KERNELS
        for way, options in ways.items()
    ]


def _skipping(scene: Scene) -> list[Variant]:
    return [
        Variant("skipping of vacuum", name, partial(_once, scene, weight=WEIGHT, skip_vacuum=skip), scene)
        for name, skip in (("on", True), ("off", False))
    ]


GROUPS = (_likelihoods, _fields, _layers, _parts, _weights, _denoisers, _defocus, _skipping)
"""Groups of variants by name."""


def _networks(scene: Scene) -> list[Variant]:
    found = [Variant("network", EMPTY, partial(empty_volume, scene), scene)]
    makers: dict[str, Callable[[], nn.Module]] = {"L2": Gaussian, "noise model": partial(_flow, scene)}
    for name, noise_model in makers.items():
        for field_name, field in (("voxels", VoxelField), ("sum of grids", MultiresolutionField)):
            make = partial(_once, scene, noise_model=noise_model, make_field=field, weight=0.0)
            found.append(Variant("network", f"{field_name}, {name}", make, scene))
    for width in WIDTHS:
        for name, noise_model in makers.items():
            make = partial(_network, scene, width, noise_model if name != "L2" else None)
            found.append(Variant("network", f"network of width {width}, {name}", make, scene))
    return found


def _network(scene: Scene, width: int, noise_model: Callable[[], nn.Module] | None) -> Best:
    return Best("no TV", fit_network(scene, width=width, noise_model=noise_model), {})


def table(cells: dict[str, Cell]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows, in the order of the groups."""
    header = ("changed", "to", "3D PSNR", "3D PSNR, affine", "2D PSNR", "2D PSNR, affine", "best setting")
    rows: list[tuple[str, ...]] = []
    for key, cell in cells.items():
        group, name = key.split("/", 1)
        figures = ("psnr raw", "psnr affine", "2d psnr raw", "2d psnr affine")
        rows.append((group, name, *(f"{cell[figure]:.2f}" for figure in figures), str(cell["setting"])))
    return header, rows
