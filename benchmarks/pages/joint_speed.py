"""Speed of the joint fit and its parts: every row is a ratio of two things timed in turn in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.scenes import in_turn, make_scene
from noiseflow import Gaussian, fit
from noiseflow.resources import kept_memory
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.fields.kinds.network import CoordinateNetwork
from recon.fields.occupancy import Occupancy
from recon.joint.joint import JointReconstructor
from recon.joint.signal_model import TomographySignal
from recon.methods.kniesel2022 import PRESETS
from recon.metrics.metrics import compare
from recon.projection.projector import SliceProjector

TILTS = "-59.5:58:1.5"
_EIGHTY = np.linspace(-60, 60, 80)
_WEIGHT = 0.3
_STEPS = 40
Row = dict[str, Any]


def joint(size: int, repeats: int = 3) -> Row:
    """The joint fit and the same field with least squares, weight given; and the joint fit that chooses everything."""
    scene = make_scene(size, tilts=TILTS)
    fits = [
        JointReconstructor(weight=_WEIGHT),
        JointReconstructor(weight=_WEIGHT, noise_model=Gaussian),
        JointReconstructor(),
    ]
    given, least_squares, chosen = (
        seconds for seconds, _ in in_turn([partial(each, scene.noisy) for each in fits], repeats=repeats)
    )
    row = {"scene": scene.name, "joint, weight given": given, "least squares, weight given": least_squares}
    return row | {"ratio": given / least_squares, "joint, everything chosen": chosen}


def chosen(size: int, repeats: int = 3) -> Row:
    """The joint fit and least squares, both with everything chosen, in turn."""
    scene = make_scene(size, tilts=TILTS)
    fits = [JointReconstructor(), JointReconstructor(noise_model=Gaussian)]
    (joint_s, joint_r), (squares_s, squares_r) = in_turn([partial(f, scene.noisy) for f in fits], repeats=repeats)
    row: Row = {"scene": scene.name, "joint": joint_s, "least squares": squares_s, "ratio": joint_s / squares_s}
    for name, found in (("joint", joint_r), ("least squares", squares_r)):
        row[f"{name}, volume PSNR (dB)"] = compare(found.volume.attenuation, scene.truth).psnr
    return row


_CROPPED = {"low-dose": ("particles", 72, 64, "-70:70:2"), "8-bit": ("filaments", 84, 60, "-65:65:2")}


def cropped(noise: str, repeats: int = 3) -> Row:
    """The joint fit of a series whose images are not square: integer counts in linear mode, or 8-bit skewed noise."""
    phantom, width, height, tilts = _CROPPED[noise]
    scene = make_scene(width, phantom=phantom, noise=noise, tilts=tilts)
    rows = slice((width - height) // 2, (width + height) // 2)
    series = scene.noisy.rows(rows)
    ((seconds, found),) = in_turn([partial(JointReconstructor(), series)], repeats=repeats)
    psnr = compare(found.volume.attenuation, scene.truth[:, rows]).psnr
    return {"scene": f"{scene.name}, {series.images.shape}", "seconds": seconds, "volume PSNR (dB)": psnr}


def scaling(sizes: list[int]) -> Row:
    """Seconds of the whole joint fit, everything chosen, against voxels × tilts, and the exponent of their power law."""
    seconds, work = [], []
    for size in sizes:
        scene = make_scene(size, tilts=TILTS)
        started = time.perf_counter()
        JointReconstructor()(scene.noisy)
        seconds.append(time.perf_counter() - started)
        work.append(size**3 * scene.noisy.num_tilts)
    exponent = float(np.polyfit(np.log(work), np.log(seconds), 1)[0])
    return {"sizes": sizes, "seconds": seconds, "exponent": exponent}


def network(size: int = 96) -> Row:
    """The paper's field, one gradient of one slice at all tilts, against its ray-wise sampling; seconds for equal rays."""
    scene = make_scene(size, tilts=TILTS)
    field = CoordinateNetwork((size, 1, size), scale=1 / size)
    projector = SliceProjector(tilt_angles=scene.noisy.tilt_angles, depth=size, width=size)
    observed = torch.rand(scene.noisy.num_tilts * size, 1, generator=torch.Generator().manual_seed(0))
    preset = replace(PRESETS["kniesel2022-as-published"], accumulate=1)
    state = preset.start(scene.noisy)

    def by_slice() -> None:
        ((torch.exp(-projector.project(field())) - observed) ** 2).mean().backward()  # type: ignore[no-untyped-call]

    (slice_wise, _), (ray_wise, _) = in_turn([by_slice, state.step], repeats=3)
    rays = scene.noisy.num_tilts * size
    row = {"rays of a slice": rays, "by slice": slice_wise, "ray by ray": ray_wise * rays / preset.rays}
    return row | {"ratio": row["ray by ray"] / slice_wise}


_NETWORK = partial(CoordinateNetwork, width=32)


def skipping(
    phantom: str, size: int, make_field: Callable[..., Any] = MultiresolutionField, tilts: str = TILTS, repeats: int = 3
) -> Row:
    """A field with vacuum and, at first, half of the resolution left out, with each of them, and with nothing; only vacuum, where
    the field has one resolution. Equal steps, noise known and weight given; whole runs."""
    scene = make_scene(size, phantom=phantom, tilts=tilts)
    everything = JointReconstructor(weight=_WEIGHT, make_field=make_field, noise_model=lambda: scene.noise_model)
    on, off = "all accelerations on", "all accelerations off"
    fits = {on: everything, off: replace(everything, skip_vacuum=False, coarse_to_fine=False)}
    if make_field is MultiresolutionField:
        fits["skipping vacuum alone"] = replace(everything, coarse_to_fine=False)
        fits["skipping resolution alone"] = replace(everything, skip_vacuum=False)
    found = dict(
        zip(fits, in_turn([partial(each, scene.noisy) for each in fits.values()], repeats=repeats), strict=True)
    )
    occupancy = found[on][1].signal_model.occupancy
    row: Row = {"scene": scene.name, "vacuum": float((scene.truth == 0).mean())}
    row["occupied"] = 1.0 if occupancy is None else occupancy.share
    for name, (seconds, result) in found.items():
        row[name] = seconds
        row[f"{name}, volume PSNR"] = compare(result.volume.attenuation, scene.truth).psnr
    return row | {"ratio": found[off][0] / found[on][0]}


def steps(phantom: str, size: int, repeats: int = 3) -> Row:
    """Milliseconds per step of the whole volume, looks at held-out pixels in the clock: with skipping of vacuum, without, and
    without the memory of freed arrays kept; noise known and weight given."""
    scene = make_scene(size, phantom=phantom, tilts=TILTS)
    noise_model = scene.noise_model.requires_grad_(False)
    observed = torch.from_numpy(np.ascontiguousarray(scene.noisy.images.transpose(0, 2, 1), dtype=np.float32))
    skipping, everywhere = (
        JointReconstructor(weight=_WEIGHT, skip_vacuum=skip).signal_model(scene.noisy, scene.grid)
        for skip in (True, False)
    )

    def run(signal_model: TomographySignal) -> None:
        fit(noise_model, signal_model, observed, digitise=False, num_steps=_STEPS)

    keep = kept_memory()
    runs = [keep(partial(run, skipping)), keep(partial(run, everywhere)), partial(run, everywhere)]
    milliseconds = [1e3 * seconds / _STEPS for seconds, _ in in_turn(runs, repeats=repeats)]
    row = dict(zip(("skipping", "everywhere", "everywhere, memory not kept"), milliseconds, strict=True))
    return {"scene": scene.name, "unit": "ms per step"} | row | {"ratio": row["everywhere"] / row["skipping"]}


def occupied(size: int, repeats: int = 3) -> Row:
    """Milliseconds of processor time per step where a cube of some share of the voxel grid is occupied, in turn; noise known."""
    scene = make_scene(size, tilts=TILTS)
    noise_model, shape = scene.noise_model.requires_grad_(False), scene.grid.shape
    models: dict[str, TomographySignal] = {}
    for share in (0.05, 0.2, 0.5, 0.9, 1.0):
        model = JointReconstructor(weight=_WEIGHT, skip_vacuum=False).signal_model(scene.noisy, scene.grid)
        edge = round(size * (1 - share ** (1 / 3)) / 2)
        rough = torch.zeros(shape)
        rough[edge : size - edge, edge : size - edge, edge : size - edge] = 1
        model.occupancy = Occupancy(rough, shape, margin=0) if edge else None
        models[f"{share:.0%}"] = model
    seconds: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(repeats):
        for name, model in models.items():
            observed = model.images().transpose(0, 2, 1)  # no voxel beside the cube is wanted
            model.keep_slopes = True
            started = time.process_time()
            fit(noise_model, model, torch.from_numpy(observed.copy()), digitise=False, num_steps=_STEPS)
            seconds[name].append(time.process_time() - started)
    row = {name: 1e3 * min(each) / _STEPS for name, each in seconds.items()}
    return {"scene": scene.name, "unit": "ms of processor time per step, by occupied share"} | row


def skipping_voxels(phantom: str) -> Row:
    """The same for a free number per voxel."""
    return skipping(phantom, 96, VoxelField)


def skipping_network(phantom: str) -> Row:
    """The same for a small coordinate network."""
    return skipping(phantom, 96, _NETWORK, "-58.5:58.5:3", repeats=1)


def projector(size: int, repeats: int = 5) -> Row:
    """Forward and back projection of a cube at 80 tilts, against ASTRA's CPU projector slice by slice, and memory bandwidth."""
    generator = torch.Generator().manual_seed(0)
    ours = SliceProjector(tilt_angles=_EIGHTY, depth=size, width=size)
    columns = torch.rand(size * size, size, generator=generator)
    rays = torch.rand(len(_EIGHTY) * size, size, generator=generator)
    theirs = _Astra(size)
    volume = columns.view(size, size, size).transpose(1, 2).contiguous().numpy()
    images = rays.view(len(_EIGHTY), size, size).transpose(1, 2).contiguous().numpy()
    slices = max(1, min(size, 2**21 // size**2))  # enough to time; every slice costs ASTRA the same
    (forward, found), (back, _), (their_forward, expected), (their_back, _) = in_turn(
        [
            lambda: ours.project(columns),
            lambda: ours.backproject(rays),
            lambda: theirs.forward(volume, slices),
            lambda: theirs.back(images, slices),
        ],
        repeats=repeats,
    )
    share = size / slices
    row = {"size": size, "tilts": len(_EIGHTY), "forward": forward, "back": back}
    row |= {"ASTRA forward": their_forward * share, "ASTRA back": their_back * share}
    row["ratio"] = (row["ASTRA forward"] + row["ASTRA back"]) / (forward + back)
    row["difference"] = _difference(found.view(len(_EIGHTY), size, size).transpose(1, 2)[:, :slices].numpy(), expected)
    return row | _bandwidth(ours, columns, rays, forward + back)


def _difference(found: np.ndarray[Any, Any], expected: np.ndarray[Any, Any]) -> float:
    return float(np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2)))


def _bandwidth(ours: SliceProjector, columns: torch.Tensor, rays: torch.Tensor, seconds: float) -> Row:
    """Bytes that must move at least (matrix, input and output once, both ways) against what copying a large array moves."""
    entries = len(ours.matrix.entries()[0])
    least = 2 * (entries * 8 + (columns.numel() + rays.numel()) * 4)
    gathered = 2 * entries * columns.shape[1] * 4
    big = torch.rand(2**26)
    target = torch.empty_like(big)
    copying, _ = in_turn([lambda: target.copy_(big)], repeats=5)[0]
    bandwidth = 2 * big.numel() * 4 / copying
    return {
        "bandwidth": bandwidth,
        "bandwidth share": least / seconds / bandwidth,
        "gathered share": gathered / seconds / bandwidth,
    }


class _Astra:
    """ASTRA's CPU projector of one slice (Joseph's interpolation), as in `benchmarks.external`."""

    def __init__(self, size: int) -> None:
        import astra

        self.astra = astra
        self.volume_geometry = astra.create_vol_geom(size, size)
        self.geometry = astra.create_proj_geom("parallel", 1.0, size, -np.deg2rad(_EIGHTY))
        self.projector = astra.create_projector("linear", self.geometry, self.volume_geometry)
        self.image = astra.data2d.create("-vol", self.volume_geometry, 0)
        self.sinogram = astra.data2d.create("-sino", self.geometry, 0)

    def forward(self, volume: np.ndarray[Any, Any], slices: int) -> np.ndarray[Any, Any]:
        """(z, y, x) to (tilt, slices, u)."""
        algorithm = self._algorithm("FP", VolumeDataId=self.image)
        images = []
        for row in range(slices):
            self.astra.data2d.store(self.image, np.ascontiguousarray(volume[:, row]))
            self.astra.algorithm.run(algorithm)
            images.append(self.astra.data2d.get(self.sinogram))
        self.astra.algorithm.delete(algorithm)
        return np.stack(images, axis=1)

    def back(self, images: np.ndarray[Any, Any], slices: int) -> np.ndarray[Any, Any]:
        """(tilt, y, u) to (z, slices, x)."""
        algorithm = self._algorithm("BP", ReconstructionDataId=self.image)
        volumes = []
        for row in range(slices):
            self.astra.data2d.store(self.sinogram, np.ascontiguousarray(images[:, row]))
            self.astra.algorithm.run(algorithm)
            volumes.append(self.astra.data2d.get(self.image))
        self.astra.algorithm.delete(algorithm)
        return np.stack(volumes, axis=1)

    def _algorithm(self, name: str, **data: int) -> Any:
        options = self.astra.astra_dict(name) | {"ProjectorId": self.projector, "ProjectionDataId": self.sinogram}
        return self.astra.algorithm.create(options | data)
