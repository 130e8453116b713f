"""Methods of other packages, for benchmarks only: ASTRA's SIRT and quantem's implicit reconstruction."""

from __future__ import annotations

import contextlib
import io
import itertools
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.methods.sirt import LineIntegralProblem
from recon.series.tilt_series import TiltSeries, VolumeGrid

Array = NDArray[Any]


def missing(package: str) -> bool:
    """Whether the package of another method is missing; the extra ``benchmark`` installs all."""
    return find_spec(package) is None


def astra_sirt(tilt_series: TiltSeries, grid: VolumeGrid, counts: Sequence[int]) -> Iterator[tuple[str, float, Array]]:
    """SIRT of the ASTRA toolbox (doi:10.1364/OE.24.025129) on the CPU, slice by slice, with non-negativity.

    Args:
        tilt_series: the data.
        grid: the voxel grid.
        counts: numbers of iterations after which to yield the volume.

    Yields:
        A label, the elapsed seconds, and the volume (z, y, x).
    """
    import astra

    started = time.perf_counter()
    measured = LineIntegralProblem.of(tilt_series, grid).line_integrals.numpy()
    volume_geometry = astra.create_vol_geom(grid.depth, grid.width)
    # ASTRA's rows are numbered downwards: z increases with the row, and tilts have the opposite sign
    angles = -np.deg2rad(tilt_series.tilt_angles)
    geometry = astra.create_proj_geom("parallel", 1.0, measured.shape[2], angles)
    projector = astra.create_projector("linear", geometry, volume_geometry)
    jobs = []
    for row in range(grid.height):
        data = astra.data2d.create("-sino", geometry, np.ascontiguousarray(measured[:, row]))
        target = astra.data2d.create("-vol", volume_geometry, 0)
        options = astra.astra_dict("SIRT")
        options |= {"ProjectorId": projector, "ProjectionDataId": data, "ReconstructionDataId": target}
        options["option"] = {"MinConstraint": 0.0}
        jobs.append((astra.algorithm.create(options), target))
    seconds, done = time.perf_counter() - started, 0
    try:
        for count in counts:
            started = time.perf_counter()
            for algorithm, _ in jobs:
                astra.algorithm.run(algorithm, count - done)
            seconds, done = seconds + time.perf_counter() - started, count
            volume = np.stack([astra.data2d.get(target) for _, target in jobs], axis=1)
            yield f"{count} iterations", seconds, volume
    finally:
        astra.clear()


def quantem_inr(
    tilt_series: TiltSeries, grid: VolumeGrid, *, budget: float, device: str = "cpu"
) -> Iterator[tuple[str, float, Array]]:
    """quantem's implicit reconstruction (``TomographyLiteINR``: an H-SIREN network, Adam at 1e-4, 1024 rays at a time).

    The default settings are used, except that poses are known and not fitted. Images must be square, with at least as many pixels
    per side as tilts (the method counts rays by the longest side of the stack), so they are padded with vacuum. The volume is cut
    out of the result, in the orientation that agrees best with a back-projection.

    Args:
        tilt_series: the data.
        grid: the voxel grid.
        budget: time in seconds after which no further pass over the data starts.
        device: torch device.

    Yields:
        A label, the elapsed seconds, and the volume (z, y, x), with arbitrary scale.
    """
    from quantem.tomography.tomography_lite import TomographyLiteINR

    problem = LineIntegralProblem.of(tilt_series, grid)
    measured = problem.line_integrals.numpy()
    rough = problem.projector.T(problem.line_integrals).numpy()
    started = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        tomography = TomographyLiteINR.from_dataset(
            _padded(measured) / measured.max(), tilt_series.tilt_angles.astype(np.float32), device=device, rng=0
        )
    seconds, passes = time.perf_counter() - started, 0
    while seconds < budget:
        started = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            tomography.reconstruct(num_iter=1, num_workers=0, learn_pose=False)
        cube = np.asarray(tomography.obj_model.obj_view).squeeze()
        seconds, passes = seconds + time.perf_counter() - started, passes + 1
        yield f"{passes} passes", seconds, _oriented(_cut(cube, max(grid.shape)), rough)


def _padded(line_integrals: Array) -> Array:
    """Pad images (tilt, y, u) with vacuum to squares with at least as many pixels per side as tilts; centres are kept."""
    tilts, height, width = line_integrals.shape
    side = max(tilts, height, width)
    side += (side - width) % 2
    margins = [((side - size) // 2, side - size - (side - size) // 2) for size in (height, width)]
    return np.pad(line_integrals, [(0, 0), *margins])


def _cut(cube: Array, side: int) -> Array:
    margin = [(size - side) // 2 for size in cube.shape]
    return cube[tuple(slice(start, start + side) for start in margin)]


def _oriented(volume: Array, like: Array) -> Array:
    """Permute and flip the axes of a volume for the best correlation with another."""
    best, found = -np.inf, volume
    for axes in itertools.permutations(range(3)):
        for steps in itertools.product((1, -1), repeat=3):
            turned = volume.transpose(axes)[tuple(slice(None, None, step) for step in steps)]
            if turned.shape == like.shape:
                agreement = float(np.corrcoef(turned.ravel(), like.ravel())[0, 1])
                if agreement > best:
                    best, found = agreement, turned
    return np.ascontiguousarray(found)
