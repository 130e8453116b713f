"""Shared parts of the benchmarks: scenes with known truth, stored results, and timing."""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from benchmarks.provenance import machine, origin
from noiseflow import io
from noiseflow.statistics import block_means
from recon.joint.joint import JointReconstructor
from recon.metrics.comparison import project
from recon.metrics.metrics import compare, compare_images
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, angles_between, clean_tilt_series, tilt_range

Array = NDArray[Any]
Cell = dict[str, Any]
EMPTY = "empty volume"
"""Name of the row without attenuation, whose score every method has to exceed."""


@dataclass(frozen=True)
class Scene:
    """A known volume and its noisy tilt series.

    Attributes:
        truth: (z, y, x) attenuation.
        clean, noisy: the tilt series without and with noise.
        test_angles: degrees, different from the tilts of the series.
        noise_model: the true noise model.
        name: description of the scene.
        device: of the fits.
    """

    truth: Array
    clean: TiltSeries
    noisy: TiltSeries
    test_angles: Array
    noise_model: nn.Module
    name: str
    device: str = "cpu"

    @property
    def grid(self) -> VolumeGrid:
        """One voxel per pixel."""
        return VolumeGrid.of(self.noisy)

    def joint(self, **options: Any) -> JointReconstructor:
        """The joint fit with these options, on the device of the scene."""
        return JointReconstructor(device=self.device, **options)

    def errors(self, volume: Array) -> dict[str, float]:
        """Errors of a volume: raw, affinely matched and min–max scaled."""
        found: dict[str, float] = {}
        for scaling in ("raw", "affine", "min-max"):
            errors = compare(volume, self.truth, scaling=scaling)
            found |= {f"psnr {scaling}": errors.psnr, f"mse {scaling}": errors.mse}
        return found

    def projection_errors(self, volume: Array) -> dict[str, float]:
        """Errors of the predicted projections at the test angles, named as by `errors`."""
        predicted, true = (project(array, self.test_angles, mode=self.noisy.mode) for array in (volume, self.truth))
        found: dict[str, float] = {}
        for scaling in ("raw", "affine", "min-max"):
            errors = compare_images(predicted, true, scaling=scaling)
            found |= {f"2d psnr {scaling}": errors.psnr, f"2d mse {scaling}": errors.mse}
            found |= {f"2d dssim {scaling}": errors.dssim}
        return found


@lru_cache(maxsize=4)
def make_scene(
    size: int,
    *,
    phantom: str = "shells",
    noise: str = "clipped",
    tilts: str = "-59.5:57.5:1.5",
    seed: int = 0,
    finer: int = 1,
) -> Scene:
    """Create a scene; the same arguments give the same voxels and the same noise.

    Args:
        size: voxels along each edge.
        phantom: one of `recon.simulate.phantoms.PHANTOMS`.
        noise: one of `recon.simulate.simulation.ACQUISITIONS` except none.
        tilts: START:STOP:STEP, degrees.
        seed: seed of the phantom; the noise uses seed + 1.
        finer: how many times finer the voxels are from which the images are made, each pixel the mean of `finer`² of theirs; else
            the projector of the images is that of the fits, and has no error.
    """
    acquisition, angles = ACQUISITIONS[noise], tilt_range(tilts)
    if acquisition.noise is None:
        raise ValueError(f"{noise} has no noise; choose an acquisition with noise")
    density = make_phantom(phantom, size * finer, generator=np.random.default_rng(seed))
    clean, unit = clean_tilt_series(density, angles, acquisition=acquisition)
    if finer > 1:
        clean = clean.with_images(block_means(clean.images, 1, finer, finer).astype(np.float32), None)
        density = block_means(density, finer, finer, finer).astype(np.float32) * finer
    noise_model = acquisition.noise()
    noisy = add_noise(clean, noise_model, seed=seed + 1)
    test_angles = angles_between(angles, 20, share=2 / 3)
    name = f"{phantom}, {noise} noise, {size}³, {len(angles)} tilts"
    return Scene(density * np.float32(unit), clean, noisy, test_angles, noise_model, name)


class Results:
    """Results of a benchmark in a JSON file: existing results are not computed again, and new ones are stored at once.

    Args:
        path: the file; it is created with the first result.
        title: name of the benchmark.
    """

    def __init__(self, path: Path, title: str) -> None:
        self.path = path
        self.content: dict[str, Any] = {"benchmark": title, "machines": [], "cells": {}}
        if path.exists():
            try:
                kept = json.loads(path.read_text(encoding="utf-8"))
            except json.JSONDecodeError as error:
                raise ValueError(f"{path} is not a results file ({error}); remove it to start over") from error
            if kept.get("benchmark") != title or "cells" not in kept:
                raise ValueError(
                    f"{path} holds results of another benchmark; remove it, or name another folder with --out"
                )
            self.content |= {name: kept[name] for name in ("machines", "cells") if name in kept}

    @property
    def cells(self) -> dict[str, Cell]:
        """All stored results."""
        cells: dict[str, Cell] = self.content["cells"]
        return cells

    def forget(self, part: str) -> None:
        """Remove results whose name contains `part`, so that they are computed again."""
        for key in [key for key in self.cells if part in key]:
            del self.cells[key]

    def take(self, path: Path) -> None:
        """Take the results of another file of the same benchmark, which replace those of the same name."""
        if not path.is_file():
            raise ValueError(f"no such file: {path}")
        given = Results(path, self.content["benchmark"])
        both = [(key, each) for each in (self, given) for key in each.cells]
        known = {key: each.content["machines"][each.cells[key]["machine"]] for key, each in both}
        machines = [place for index, place in enumerate(known.values()) if place not in list(known.values())[:index]]
        cells = {key: each.cells[key] | {"machine": machines.index(known[key])} for key, each in both}
        self.content |= {"machines": machines, "cells": cells}
        self._save()

    def _save(self) -> None:
        with io.atomic_path(self.path) as partial:
            partial.write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")

    def cell(self, key: str, compute: Callable[[], Cell]) -> Cell:
        """The result of a name; if missing, it is computed and stored with commit, date, machine and initial load."""
        if key not in self.cells:
            load, here = os.getloadavg()[0], machine()
            found = compute()
            if here not in self.content["machines"]:
                self.content["machines"].append(here)
            place = {"load": round(load, 1), "machine": self.content["machines"].index(here)} | origin()
            self.cells[key] = plain(found | place)
            self._save()
        return self.cells[key]


def plain(value: Any) -> Any:
    """Convert values for JSON: numbers are rounded to five digits, and non-finite ones become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.5g}") if np.isfinite(value) else None
    return value


def in_turn(functions: Sequence[Callable[[], Any]], *, repeats: int) -> list[tuple[float, Any]]:
    """Median seconds and last result of each function, called in turn so that background load affects all equally."""
    seconds: list[list[float]] = [[] for _ in functions]
    results: list[Any] = [None] * len(functions)
    for _ in range(repeats):
        for index, function in enumerate(functions):
            started = time.perf_counter()
            results[index] = function()
            seconds[index].append(time.perf_counter() - started)
    return [(statistics.median(times), result) for times, result in zip(seconds, results, strict=True)]
