"""Simulation of tilt series of any size to files, with only blocks of slices and a few tilts in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mrcfile
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from noiseflow.io import output_folder, partial_folder
from noiseflow.io.mapped import create_mrc, finish_mrc
from noiseflow.progress import Progress
from noiseflow.runs.outputs import reserve_room
from noiseflow.runs.partials import link_target
from recon.projection.defocused_projector import DefocusedProjector, with_defocus
from recon.projection.projector import SliceProjector
from recon.series.dual_axis import own_images
from recon.series.files import write_angles
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import Acquisition, draw_noise, stored_type

Array = NDArray[Any]
_BLOCK_VOXELS, _MATRIX_ENTRIES = 2**24, 2**24


@dataclass(frozen=True)
class Simulation:
    """Settings of a simulation.

    Attributes:
        phantom: one of `recon.simulate.phantoms.PHANTOMS`.
        size: voxels along each edge.
        angles: degrees by name of the stack: ``clean`` and optionally ``clean_second``, ``validation`` and ``test``.
        acquisition: acquisition settings.
        noise_model: noise model for the ``clean`` stacks, or None.
        seed: seed of the phantom and of the noise.
        defocus: depth-dependent blur of the ``clean`` stacks, see
            `recon.projection.defocused_projector.DefocusedProjector`; the other stacks are in focus.
    """

    phantom: str
    size: int
    angles: dict[str, NDArray[np.float64]]
    acquisition: Acquisition
    noise_model: nn.Module | None = None
    seed: int = 0
    defocus: float = 0.0

    @property
    def num_steps(self) -> int:
        """Number of steps that `write` reports: blocks drawn, blocks projected, and images written."""
        blocks = len(list(self._blocks()))
        tilts = sum(len(angles) for angles in self.angles.values())
        return blocks * (1 + sum(-(-len(angles) // self._together) for angles in self.angles.values())) + tilts

    @property
    def _together(self) -> int:
        return max(1, _MATRIX_ENTRIES // (2 * self.size**2))

    def _blocks(self) -> Iterator[slice]:
        step = max(1, _BLOCK_VOXELS // self.size**2)
        yield from (slice(start, min(start + step, self.size)) for start in range(0, self.size, step))

    def write(self, folder: Path, progress: Progress = lambda task, done, total, note: None) -> float:
        """Write ``truth.mrc``, the clean stacks by name and the noisy ``tilts.mrc``, with their angles, to a folder.

        ``clean_second`` shows the volume turned in its plane by 90°, about a second tilt axis; its noisy stack is
        ``tilts_second.mrc``. The files appear when all are complete; a failed run leaves none.

        Returns:
            The factor from the density of the phantom to the attenuation of the truth.

        Raises:
            ValueError: the phantom is unknown or empty.
        """
        with output_folder(folder), partial_folder(folder / "simulate") as partial:
            unit = _Writer(self, partial, progress).run()
            for path in partial.glob("*.mrc"):
                finish_mrc(path, stack=path.stem != "truth")
            for path in sorted(partial.iterdir()):
                path.replace(link_target(folder / path.name))
        return unit


class _Writer:
    def __init__(self, simulation: Simulation, folder: Path, progress: Progress) -> None:
        self.simulation, self.folder, self.progress, self.done = simulation, folder, progress, 0

    def run(self) -> float:
        plan = self.simulation
        with self._new("truth", (plan.size,) * 3, np.float32) as truth:
            for rows in plan._blocks():
                drawn = make_phantom(plan.phantom, plan.size, generator=np.random.default_rng(plan.seed), rows=rows)
                truth.data[:, rows] = drawn
                self._step("drawing")
            highest = max(self._project(name, truth.data) for name in plan.angles)
            if not highest > 0:
                raise ValueError("the volume is empty; choose another phantom or a larger size")
            unit = plan.acquisition.unit(highest)
            for rows in plan._blocks():
                truth.data[:, rows] *= np.float32(unit)
        for name in plan.angles:
            self._read_out(name, plan.acquisition.peak / highest)
        return unit

    def _project(self, name: str, truth: Array) -> float:
        """Write the line integrals of one stack, and return the largest one in focus; that of the first stack sets the unit."""
        truth = own_images(truth) if name == "clean_second" else truth
        plan, angles, highest = self.simulation, self.simulation.angles[name], 0.0
        with self._new(name, (len(angles), plan.size, plan.size), np.float32) as stack:
            for start in range(0, len(angles), plan._together):
                part = angles[start : start + plan._together]
                projector = SliceProjector(tilt_angles=part, depth=plan.size, width=plan.size)
                blurred = with_defocus(projector, plan.defocus if name.startswith("clean") else 0.0)
                for rows in plan._blocks():
                    images = sharp = projector(torch.from_numpy(np.array(truth[:, rows])))
                    if isinstance(blurred, DefocusedProjector):
                        images = _with_rim(blurred, truth, rows)
                    stack.data[start : start + len(part), rows] = images.numpy()
                    highest = max(highest, float(sharp.max()))
                    self._step("projecting")
        write_angles(self.folder / f"{name}.rawtlt", angles)
        return highest if name == "clean" else 0.0

    def _read_out(self, name: str, factor: float) -> None:
        plan = self.simulation
        with mrcfile.mmap(self.folder / f"{name}.mrc", "r+") as clean:
            for image in clean.data:
                image[:] = plan.acquisition.signal(torch.from_numpy(image * np.float32(factor))).numpy()
                self._step("reading out")
            if name.startswith("clean"):
                self._add_noise(name.replace("clean", "tilts"), clean.data)

    def _add_noise(self, name: str, clean: Array) -> None:
        plan, seed = self.simulation, self.simulation.seed + (name != "tilts")
        with self._new(name, clean.shape, stored_type(plan.noise_model)) as noisy:
            drawn = clean if plan.noise_model is None else draw_noise(clean, plan.noise_model, seed=seed)
            for target, image in zip(noisy.data, drawn, strict=True):
                target[:] = image
        write_angles(self.folder / f"{name}.rawtlt", plan.angles["clean"])

    def _new(self, name: str, shape: tuple[int, ...], dtype: type[np.generic]) -> Any:
        path = self.folder / f"{name}.mrc"
        stack = create_mrc(path, shape, np.dtype(dtype if dtype is np.uint8 else np.float32))
        with path.open("r+b") as stream:
            reserve_room(stream.fileno(), path.stat().st_size)
        return stack

    def _step(self, note: str) -> None:
        self.done += 1
        self.progress("simulate", self.done, self.simulation.num_steps, note)


def _with_rim(projector: DefocusedProjector, volume: Array, rows: slice) -> torch.Tensor:
    """Images (tilt, y, u) of some slices, including blur from their neighbours."""
    rim = projector.reach
    start, stop = max(0, rows.start - rim), min(volume.shape[1], rows.stop + rim)
    images = projector(torch.from_numpy(np.array(volume[:, start:stop])))
    return images[:, rows.start - start : rows.stop - start]
