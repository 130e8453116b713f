"""Simulation of tilt series from known volumes with known noise."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mrcfile
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised, io
from noiseflow.io import mapped, output_folder, partial_folder
from noiseflow.io.angles import LARGEST_ANGLE
from noiseflow.io.checks import number
from noiseflow.io.mapped import create_mrc, finish_mrc
from noiseflow.progress import Progress
from noiseflow.runs.ownership import link_target
from noiseflow.statistics import Array
from recon.projection.defocused_projector import DefocusedProjector, with_defocus
from recon.projection.projector import SliceProjector
from recon.series.files import write_angles
from recon.series.orientation import own_images
from recon.series.tilt_series import Mode, TiltSeries
from recon.simulate.noises import CountingNoise, OutlierNoise, SkewedNoise
from recon.simulate.phantoms import make_phantom


@dataclass(frozen=True)
class Acquisition:
    """Acquisition settings of a simulated series.

    Attributes:
        noise: function that creates the true noise model, or None for clean images.
        peak: the largest line integral, which sets the unit of attenuation.
        intensity: incident intensity (transmission) or gain (linear), detector units.
    """

    noise: Callable[[], nn.Module] | None
    mode: Mode = "transmission"
    peak: float = 1.5
    intensity: float = 1.0

    def signal(self, line_integrals: Tensor) -> Tensor:
        return self.intensity * (line_integrals if self.mode == "linear" else torch.exp(-line_integrals))

    def unit(self, highest: float) -> float:
        """The factor from density with largest line integral `highest` to attenuation (times gain in linear mode)."""
        return self.peak / highest * (self.intensity if self.mode == "linear" else 1.0)

    @property
    def brightest(self) -> float:
        """The largest possible signal."""
        return self.intensity * (self.peak if self.mode == "linear" else 1.0)


ACQUISITIONS = {
    "none": Acquisition(None),
    "clipped": Acquisition(lambda: Digitised(SkewedNoise(0.05, 0.2), step=0.0, low=0.0, high=1.0)),
    "gaussian": Acquisition(lambda: SkewedNoise(0.1, 0.0)),
    "skewed": Acquisition(lambda: SkewedNoise(0.05, 0.15, skewness=0.7)),
    "outliers": Acquisition(lambda: OutlierNoise(0.05, 0.1, share=0.05, factor=8.0)),
    "low-dose": Acquisition(lambda: CountingNoise(read_noise=0.5), mode="linear", peak=8.0),
    "8-bit": Acquisition(
        lambda: Digitised(SkewedNoise(10.0, 0.15, skewness=0.3), step=1.0, low=0.0, high=255.0), intensity=200.0
    ),
}
"""Acquisitions by name; ``clipped`` resembles the synthetic data of Kniesel et al. (CVPR 2022)."""


def clean_tilt_series(
    volume: NDArray[np.floating[Any]] | torch.Tensor,
    tilt_angles: Sequence[float] | NDArray[np.floating[Any]],
    *,
    acquisition: Acquisition = ACQUISITIONS["none"],
    pixel_size: float | None = None,
) -> tuple[TiltSeries, float]:
    """Project a known volume without noise.

    Args:
        volume: (z, y, x) density, any unit, array or tensor.
        tilt_angles: degrees.
        pixel_size: Å.

    Returns:
        The series, and the factor from density to attenuation per voxel (times the gain in linear mode).

    Raises:
        ValueError: the volume is empty.

    Example:
        >>> import numpy as np, recon
        >>> series, unit = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), [-60.0, 0.0, 60.0])
        >>> series.images.shape, bool(series.images.max() <= 1)  # transmission of an incident intensity of 1
        ((3, 16, 16), True)
    """
    projector = SliceProjector(tilt_angles=tilt_angles, depth=volume.shape[0], width=volume.shape[2])
    line_integrals = projector(torch.from_numpy(np.asarray(io.as_array(volume), dtype=np.float32)))
    highest = float(line_integrals.max())
    if not highest > 0:
        raise ValueError("the volume is empty; give one with positive density")
    line_integrals = line_integrals * (acquisition.peak / highest)
    signal = acquisition.signal(line_integrals)
    unit = acquisition.unit(highest)
    return TiltSeries(signal.contiguous().numpy(), np.asarray(tilt_angles), pixel_size, acquisition.mode), unit


def add_noise(tilt_series: TiltSeries, noise_model: nn.Module, *, seed: int = 0) -> TiltSeries:
    """Draw a noisy observation of every pixel of a clean series; rounded values are stored as integers.

    Example:
        >>> import noiseflow, numpy as np, recon
        >>> density = np.random.default_rng(0).random((8, 8, 8))
        >>> clean, _ = recon.clean_tilt_series(density, [0.0, 30.0])
        >>> noisy = recon.add_noise(clean, noiseflow.Gaussian(0.1), seed=1)
        >>> noisy.images.shape
        (2, 8, 8)
    """
    noisy = np.stack(list(draw_noise(tilt_series.images, noise_model, seed=seed))).astype(stored_type(noise_model))
    return TiltSeries(noisy, tilt_series.tilt_angles, tilt_series.pixel_size, tilt_series.mode)


def draw_noise(images: NDArray[Any], noise_model: nn.Module, *, seed: int) -> Iterator[NDArray[Any]]:
    """Yield a noisy observation of each clean image (y, x)."""
    generator = torch.Generator().manual_seed(seed)
    for image in images:
        with torch.no_grad():
            yield noise_model(torch.from_numpy(np.array(image))).sample(generator=generator).numpy()


def stored_type(noise_model: nn.Module | None) -> type[np.generic]:
    """The data type of pixel values: integers if the noise model rounds to whole numbers."""
    if not isinstance(noise_model, Digitised) or noise_model.step != 1:
        return np.float32
    return np.uint8 if (noise_model.low, noise_model.high) == (0, 255) else np.int32


def tilt_range(text: str) -> NDArray[np.float64]:
    """Parse ``START:STOP:STEP`` in degrees, both ends included. Raises ValueError if the text does not hold three numbers, the
    range is empty or too fine, or angles exceed two full turns.
    """
    try:
        start, stop, step = (number(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"tilts '{text}': give START:STOP:STEP in degrees, such as -60:60:2") from None
    if not (step and np.isfinite([start, stop, step]).all() and (stop - start) / step >= 0):
        raise ValueError(f"tilts '{text}': the step does not lead from START to STOP")
    if (stop - start) / step > 10_000:
        raise ValueError(f"tilts '{text}': more than 10000 tilts; give a larger step")
    if max(abs(start), abs(stop)) > LARGEST_ANGLE:
        raise ValueError(f"tilts '{text}': give degrees within ±{LARGEST_ANGLE}")
    return np.round(start + step * np.arange(int((stop - start) / step + 1e-6) + 1), 6)


def angles_between(tilt_angles: NDArray[np.floating[Any]], count: int, *, share: float) -> NDArray[np.float64]:
    """Angles between the tilts of a series, evenly spread over its range: `share` of the way from one tilt to the next.

    Args:
        tilt_angles: degrees.
        share: between 0 and 1; different shares give different angles.
    """
    ordered = np.unique(tilt_angles)
    between = ordered[:-1] + share * np.diff(ordered)
    chosen = np.unique(np.round(np.linspace(0, len(between) - 1, min(count, len(between)))).astype(int))
    return np.asarray(np.round(between[chosen], 6))


@dataclass(frozen=True)
class Simulation:
    """Settings of a simulation.

    Attributes:
        phantom: one of `recon.simulate.phantoms.PHANTOMS`.
        angles: degrees by name of the stack: ``clean`` and optionally ``clean_second``, ``validation`` and ``test``.
        noise_model: noise model for the ``clean`` stacks, or None.
        defocus: depth-dependent blur of the ``clean`` stacks, see
            `recon.projection.defocused_projector.DefocusedProjector`; the other stacks are in focus.
    """

    phantom: str
    size: int
    angles: dict[str, NDArray[np.float64]]
    acquisition: Acquisition
    noise_model: nn.Module | None
    seed: int
    defocus: float

    @property
    def num_steps(self) -> int:
        """Number of steps that `write` reports: blocks drawn, blocks projected, and images written."""
        blocks = len(list(self._blocks()))
        tilts = sum(len(angles) for angles in self.angles.values())
        return blocks * (1 + sum(-(-len(angles) // self._together) for angles in self.angles.values())) + tilts

    @property
    def _together(self) -> int:
        return max(1, mapped.PART // (8 * self.size**2))

    def _blocks(self) -> Iterator[slice]:
        step = max(1, mapped.PART // (4 * self.size**2))
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
        count = itertools.count(1)

        def step(note: str) -> None:
            progress("simulate", next(count), self.num_steps, note)

        with output_folder(folder), partial_folder(folder / "simulate") as partial:
            unit = self._draw(partial, step)
            for path in partial.glob("*.mrc"):
                finish_mrc(path, stack=path.stem != "truth")
            for path in sorted(partial.iterdir()):
                path.replace(link_target(folder / path.name))
        return unit

    def _draw(self, folder: Path, step: Callable[[str], None]) -> float:
        with _new(folder / "truth.mrc", (self.size,) * 3) as truth:
            for rows in self._blocks():
                drawn = make_phantom(self.phantom, self.size, generator=np.random.default_rng(self.seed), rows=rows)
                truth.data[:, rows] = drawn
                step("drawing")
            highest = max(self._project(folder, name, truth.data, step) for name in self.angles)
            if not highest > 0:
                raise ValueError("the volume is empty; choose another phantom or a larger size")
            unit = self.acquisition.unit(highest)
            for rows in self._blocks():
                truth.data[:, rows] *= np.float32(unit)
        for name in self.angles:
            self._read_out(folder, name, self.acquisition.peak / highest, step)
        return unit

    def _project(self, folder: Path, name: str, truth: Array, step: Callable[[str], None]) -> float:
        """Write the line integrals of one stack, and return the largest one in focus; that of the first stack sets the unit."""
        truth = own_images(truth) if name == "clean_second" else truth
        angles, highest = self.angles[name], 0.0
        with _new(folder / f"{name}.mrc", (len(angles), self.size, self.size)) as stack:
            for start in range(0, len(angles), self._together):
                part = angles[start : start + self._together]
                projector = SliceProjector(tilt_angles=part, depth=self.size, width=self.size)
                blurred = with_defocus(projector, self.defocus if name.startswith("clean") else 0.0)
                for rows in self._blocks():
                    images = sharp = projector(torch.from_numpy(np.array(truth[:, rows])))
                    if isinstance(blurred, DefocusedProjector):  # including blur from the slices beside them
                        above = max(0, rows.start - blurred.reach)
                        wide = blurred(torch.from_numpy(np.array(truth[:, above : rows.stop + blurred.reach])))
                        images = wide[:, rows.start - above : rows.stop - above]
                    stack.data[start : start + len(part), rows] = images.numpy()
                    highest = max(highest, float(sharp.max()))
                    step("projecting")
        write_angles(folder / f"{name}.rawtlt", angles)
        return highest if name == "clean" else 0.0

    def _read_out(self, folder: Path, name: str, factor: float, step: Callable[[str], None]) -> None:
        """Turn the line integrals of one stack into clean images, and write the noisy ones of the series."""
        with mrcfile.mmap(folder / f"{name}.mrc", "r+") as clean:
            for image in clean.data:
                image[:] = self.acquisition.signal(torch.from_numpy(image * np.float32(factor))).numpy()
                step("reading out")
            if not name.startswith("clean"):
                return
            noisy_name, model = name.replace("clean", "tilts"), self.noise_model
            seed = self.seed + (noisy_name != "tilts")
            with _new(folder / f"{noisy_name}.mrc", clean.data.shape, stored_type(model)) as noisy:
                drawn = clean.data if model is None else draw_noise(clean.data, model, seed=seed)
                for target, image in zip(noisy.data, drawn, strict=True):
                    target[:] = image
        write_angles(folder / f"{noisy_name}.rawtlt", self.angles["clean"])


def _new(path: Path, shape: tuple[int, ...], dtype: type[np.generic] = np.float32) -> Any:
    return create_mrc(path, shape, np.dtype(dtype if dtype is np.uint8 else np.float32))
