"""Accuracy of the joint fit: against the oracle that is given the true noise, and least squares at its best weight."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from torch import nn

from benchmarks.scenes import Scene, make_scene
from noiseflow import Digitised, Gaussian
from recon.fields.fields import Field
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.joint.joint import JointReconstructor
from recon.metrics.metrics import compare
from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries
from recon.simulate.noises import SkewedNoise
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, Acquisition, add_noise, clean_tilt_series, tilt_range

PHANTOMS = ("shells", "virions", "filaments", "particles", "slab")
NOISES = ("clipped", "skewed", "outliers", "low-dose", "8-bit")
_LOWEST, _HIGHEST, _RUNGS, _SEARCHES, _SLAB = 0.05, 2.0, 5, 4, 24
Row = dict[str, Any]


def true_noise(name: str) -> nn.Module:
    """The noise model that a series was drawn from."""
    make = ACQUISITIONS[name].noise
    if make is None:
        raise ValueError(f"{name} has no noise to learn")
    return make()


def score(reconstructor: JointReconstructor, scene: Scene) -> Row:
    """Reconstruct, and compare volume and projections with the truth, raw, dB."""
    started = time.perf_counter()
    result = reconstructor(scene.noisy)
    seconds = time.perf_counter() - started
    response = result.signal_model.image_formation
    level = response.offset if scene.noisy.mode == "linear" else response.intensity
    return {
        "weight": float(result.signal_model.weight),
        "volume": compare(result.volume.attenuation, scene.truth).psnr,
        "projections": compare(result.projections, scene.clean.images).psnr,
        "noise model": _name(result.noise_model),
        "offset" if scene.noisy.mode == "linear" else "intensity": float(level.mean()),
        "seconds": seconds,
    }


def _name(noise_model: nn.Module) -> str:
    return type(noise_model.model if isinstance(noise_model, Digitised) else noise_model).__name__


def best_weight(reconstructor: JointReconstructor, scene: Scene) -> float:
    """The weight of the highest volume PSNR on the slices that vary most: only a rival may look there. Golden section about
    the best of a few, for chance dents the curve far from its peak."""
    slab = _slab(scene)

    def loss(log_weight: float) -> float:
        return -float(score(replace(reconstructor, weight=math.exp(log_weight)), slab)["volume"])

    ladder = np.linspace(math.log(_LOWEST), math.log(_HIGHEST), _RUNGS)
    best = int(np.argmin([loss(rung) for rung in ladder]))
    return math.exp(golden_section(loss, ladder[max(0, best - 1)], ladder[min(best + 1, _RUNGS - 1)], _SEARCHES))


def golden_section(loss: Callable[[float], float], low: float, high: float, count: int) -> float:
    """The place of the lowest of `count` values of a function with one minimum (Kiefer 1953)."""
    share = (math.sqrt(5) - 1) / 2
    left, right = high - share * (high - low), low + share * (high - low)
    seen = {left: loss(left), right: loss(right)}
    for _ in range(count - 2):
        if seen[left] <= seen[right]:
            high, right = right, left
            left = high - share * (high - low)
        else:
            low, left = left, right
            right = low + share * (high - low)
        for place in (left, right):
            if place not in seen:
                seen[place] = loss(place)
    return min(seen, key=lambda place: seen[place])


def _slab(scene: Scene) -> Scene:
    rows = contrast_slab(scene.noisy, _SLAB)

    def cut(series: TiltSeries) -> TiltSeries:
        return TiltSeries(series.images[:, rows], series.tilt_angles, series.pixel_size, series.mode)

    return replace(scene, truth=scene.truth[:, rows], clean=cut(scene.clean), noisy=cut(scene.noisy))


def accuracy(phantom: str, noise: str, *, size: int, tilts: str, seed: int, finer: int, kept: Row | None = None) -> Row:
    """One row: the joint fit as a user gets it, the oracle at its best weight, and least squares at its best weight; the
    best weights are those of a kept row, where one is given. See `make_scene` for `finer`."""
    scene = make_scene(size, phantom=phantom, noise=noise, tilts=tilts, seed=seed, finer=finer)
    row: Row = {"phantom": phantom, "noise": noise, "size": size, "seed": seed, "finer": finer}
    row["images"] = compare(scene.noisy.images, scene.clean.images).psnr
    row["joint"] = score(JointReconstructor(), scene)
    rivals = {
        "oracle": JointReconstructor(noise_model=lambda: true_noise(noise)),
        "least squares": JointReconstructor(noise_model=Gaussian),
    }
    for name, rival in rivals.items():
        rivals[name] = replace(rival, weight=kept[name]["weight"] if kept else best_weight(rival, scene))
    row["oracle"], least_squares = score(rivals["oracle"], scene), rivals["least squares"]
    variants = [score(replace(least_squares, estimate_response=estimate), scene) for estimate in (True, False)]
    row["least squares"] = max(variants, key=lambda found: found["volume"])
    return row


FIELDS: dict[str, Callable[..., Field]] = {"voxels": VoxelField, "sum of grids": MultiresolutionField}


def fields(phantom: str, *, size: int, tilts: str, seed: int, noise: str = "clipped") -> Row:
    """One row: every field at its own best weight, given the true noise."""
    scene = make_scene(size, phantom=phantom, noise=noise, tilts=tilts, seed=seed)
    row: Row = {"phantom": phantom, "noise": noise, "size": size, "seed": seed}
    for name, make in FIELDS.items():
        oracle = JointReconstructor(noise_model=lambda: true_noise(noise), make_field=make)
        row[name] = score(replace(oracle, weight=best_weight(oracle, scene)), scene)
    return row


def offset(phantom: str, *, size: int, tilts: str, seed: int, injected: float = 0.1) -> Row:
    """The offset that the joint fit finds in a linear series whose readings were all raised by a known one."""
    acquisition = Acquisition(lambda: SkewedNoise(0.05, 0.1, skewness=0.7), mode="linear")
    density = make_phantom(phantom, size, generator=np.random.default_rng(seed))
    clean, _ = clean_tilt_series(density, tilt_range(tilts), acquisition=acquisition)
    noisy = add_noise(clean, SkewedNoise(0.05, 0.1, skewness=0.7), seed=seed + 1)
    raised = replace(noisy, images=noisy.images + np.float32(injected))
    found = float(JointReconstructor()(raised).signal_model.image_formation.offset.mean())
    return {"phantom": phantom, "size": size, "seed": seed, "injected": injected, "found": found}
