"""The Fourier shell correlation of a volume with a truth that nobody knows: a band, from samples of the posterior.

Each sample is a truth that the images and the regulariser allow. Their mean differs from the volume, which is the most likely
of them, by the bias. The lower edge counts all of it: the correlation of the volume with the samples, which 95 % of them
exceed. The upper edge counts none: that with samples moved so that their mean is the volume.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.described import described
from noiseflow.io import atomic_path
from noiseflow.io.ownership import signature
from recon.metrics.metrics import resolution, shells_of

Array = NDArray[np.float64]
_LEVEL = 0.9  # as the intervals of voxels: a twentieth of the samples correlate less
_COLUMNS = "frequency (cycles per voxel),low,high"
_FEWEST = 4  # voxels along an axis: two shells, of which the first is the mean


@described(frequency="cycles per voxel")
@dataclass(frozen=True)
class ShellBand:
    """Between which values the Fourier shell correlation of a volume with the truth is expected.

    Attributes:
        frequency: (N,) cycles per voxel.
        low, high: (N,) correlation.
    """

    frequency: Array
    low: Array
    high: Array

    def resolution(self, threshold: float = 0.5) -> tuple[float, float]:
        """Where the lower and the upper edge fall below a threshold, cycles per voxel; see `recon.metrics.metrics.resolution`."""
        low, high = (resolution(self.frequency, edge, threshold) for edge in (self.low, self.high))
        return low, high

    def in_words(self, voxel_size: float | None, threshold: float = 0.5) -> str:
        """The range of the resolution, and as a length where the voxels (Å) are known."""
        ends = self.resolution(threshold)
        words = f"{ends[0]:.3f} to {ends[1]:.3f} cycles per voxel"
        if not voxel_size or not ends[0]:
            return words
        coarse, fine = (voxel_size / end for end in ends)
        size, unit = (10, "nm") if fine >= 10 else (1, "Å")
        return f"{words} ({coarse / size:.3g} to {fine / size:.3g} {unit})"

    def write(self, path: str | Path) -> None:
        """Write a table of comma-separated values, one line per shell."""
        with atomic_path(path) as partial:
            table = np.stack([self.frequency, self.low, self.high], axis=1)
            title = f"# {signature()}: Fourier shell correlation with the truth, 90 % band\n{_COLUMNS}"
            np.savetxt(partial, table, delimiter=",", fmt="%.6g", header=title, comments="")

    @classmethod
    def read(cls, path: str | Path) -> ShellBand:
        """What `write` wrote.

        Raises:
            ValueError: another table.
        """
        try:
            _, columns, *lines = Path(path).read_text(encoding="utf-8").splitlines()
            if columns != _COLUMNS:
                raise ValueError(columns)
            return cls(*np.array([[float(value) for value in line.split(",")] for line in lines]).T)
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path} is not the table of correlations that noiseflow writes beside a volume; remove it"
            ) from error


@dataclass(frozen=True)
class ShellPowers:
    """Sums over the frequencies of each shell, of a volume and of samples; those of parts of a volume add up.

    Attributes:
        cross: (sample, shell) of the products of sample and volume.
        power: (sample, shell) of the power of each sample.
        own, common: (shell,) of the power of the volume and of the samples' mean.
    """

    cross: Array
    power: Array
    own: Array
    common: Array

    def table(self) -> Array:
        """All in one array, which `of` takes; tables of parts add up."""
        return np.concatenate([self.cross, self.power, self.own[None], self.common[None]])

    @classmethod
    def of(cls, table: Array) -> ShellPowers:
        """What `table` gave."""
        count = len(table) // 2 - 1
        return cls(table[:count], table[count:-2], table[-2], table[-1])

    def band(self) -> ShellBand | None:
        """The band; None of a volume that is fewer than four voxels thick, or without samples."""
        count, shells = len(self.power), len(self.own) - 1
        if 2 * shells < _FEWEST or not count:
            return None
        norm = np.sqrt(self.power * self.own)
        curves = np.divide(self.cross, norm, out=np.zeros_like(self.cross), where=norm > 0)
        spread = np.maximum(self.power.mean(0) - self.common, 0) * count / max(1, count - 1)
        total = self.own + spread
        high = np.sqrt(np.divide(self.own, total, out=np.zeros_like(total), where=total > 0))
        low = np.quantile(curves, (1 - _LEVEL) / 2, axis=0)
        return ShellBand(np.arange(shells + 1) / (2 * shells), low, np.maximum(low, high))


class ShellSums:
    """Sums by shell of the spectra of a volume and of samples seen one by one.

    A part of a volume shows the powers of the whole, as in P. D. Welch's estimate of power spectra (1967,
    doi:10.1109/TAU.1967.1161901), if each of its slices counts by a share and the squares of all parts' shares add up to one.

    Args:
        volume: (z, y, x).
        shares: (y,) of the slices of a part; None counts all of them in full.
        height: slices of the whole volume, where this is a part of it.
    """

    def __init__(self, volume: Tensor, *, shares: Tensor | None = None, height: int | None = None) -> None:
        shape = volume.shape
        self.shells = min(shape[0], height or shape[1], shape[2]) // 2
        self.shares = None if shares is None else shares.to(volume)[:, None]
        index, times = shells_of(tuple(shape), self.shells)
        inside = np.minimum(index, self.shells + 1)  # one more for the corners, which nobody looks at
        self.index = torch.from_numpy(inside.ravel().astype(np.int32)).to(volume.device)
        self.times = torch.from_numpy(times.astype(np.float32)).to(volume.device)
        self.spectrum = self._spectrum(volume)
        self.cross: list[Tensor] = []  # one entry per sample: (shells + 1,)
        self.power: list[Tensor] = []
        self.total = torch.zeros_like(self.spectrum)

    def add(self, sample: Tensor) -> None:
        """Take a sample in, (z, y, x)."""
        spectrum = self._spectrum(sample)
        self.cross.append(self._by_shell((spectrum * self.spectrum.conj()).real))
        self.power.append(self._power(spectrum))
        self.total += spectrum

    def powers(self) -> ShellPowers:
        """The sums so far."""
        count = len(self.power)
        none = np.zeros((0, self.shells + 1))
        cross, power = (torch.stack(sums).numpy() if sums else none for sums in (self.cross, self.power))
        return ShellPowers(
            cross, power, self._power(self.spectrum).numpy(), self._power(self.total / max(1, count)).numpy()
        )

    def state(self) -> dict[str, Any]:
        """What `load_state` takes."""
        return {"cross": self.cross[:], "power": self.power[:], "total": self.total.clone()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.cross, self.power, self.total = state["cross"][:], state["power"][:], state["total"].clone()

    def _spectrum(self, volume: Tensor) -> Tensor:
        spectrum: Tensor = torch.fft.rfftn(volume if self.shares is None else volume * self.shares, norm="ortho")
        return spectrum

    def _power(self, spectrum: Tensor) -> Tensor:
        return self._by_shell(spectrum.abs().square())

    def _by_shell(self, values: Tensor) -> Tensor:
        sums = torch.bincount(self.index, weights=(values * self.times).ravel().double(), minlength=self.shells + 2)
        return sums[: self.shells + 1].cpu()
