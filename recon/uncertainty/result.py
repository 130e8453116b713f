"""Error bars of a volume, the expected shell correlation with the unknown truth, and their files: ``volume_std.mrc``,
``volume_bias.mrc``, ``volume_wedge.mrc`` and ``volume_fsc.csv`` next to ``volume.mrc``.

Each posterior sample is a possible truth. The mean of the samples differs from the volume, the posterior mode, by the bias. The
lower edge of the band of correlations includes the bias: it is the correlation of the volume with samples that 95 % of them
exceed. The upper edge excludes the bias: the samples are shifted so that their mean is the volume.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

from noiseflow.described import described
from noiseflow.io import atomic_path
from noiseflow.runs.ownership import signature
from recon.metrics.metrics import frequencies_in_words, resolution, shells_of
from recon.series.tilt_series import Volume

Array = NDArray[np.float64]
LEVEL = 0.9  # usual probability of an interval
_COLUMNS = "frequency (cycles per voxel),low,high"


@described(frequency="cycles per voxel")
@dataclass(frozen=True)
class ShellBand:
    """The band in which the Fourier shell correlation of a volume with the truth is expected.

    Attributes:
        frequency: (N,) cycles per voxel.
        low, high: (N,) correlation.
    """

    frequency: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, powers: Array) -> ShellBand | None:
        """The band from the table of `ShellSums`, or the sum of those of all parts of a volume; None without samples or if an
        axis has fewer than four voxels."""
        count, shells = len(powers) // 2 - 1, powers.shape[1] - 1
        if shells < 2 or not count:  # the first shell is the mean
            return None
        cross, power, own, common = powers[:count], powers[count:-2], powers[-2], powers[-1]
        norm = np.sqrt(power * own)
        curves = np.divide(cross, norm, out=np.zeros_like(cross), where=norm > 0)
        spread = np.maximum(power.mean(0) - common, 0) * count / max(1, count - 1)
        total = own + spread
        high = np.sqrt(np.divide(own, total, out=np.zeros_like(total), where=total > 0))
        low = np.quantile(curves, 0.05, axis=0)  # of 90 %, as the intervals of voxels
        return cls(np.arange(shells + 1) / (2 * shells), low, np.maximum(low, high))

    def resolution(self, threshold: float = 0.5) -> tuple[float, float]:
        """Frequencies at which lower and upper edge fall below a threshold, see `recon.metrics.metrics.resolution`."""
        low, high = (resolution(self.frequency, edge, threshold) for edge in (self.low, self.high))
        return low, high

    def in_words(self, voxel_size: float | None, threshold: float = 0.5) -> str:
        """The range of the resolution, also as a length if the voxel size (Å) is known."""
        return frequencies_in_words(self.resolution(threshold), voxel_size)

    def write(self, path: str | Path) -> None:
        """Write a CSV table with one line per shell."""
        with atomic_path(path) as partial:
            table = np.stack([self.frequency, self.low, self.high], axis=1)
            title = f"# {signature()}: Fourier shell correlation with the truth, 90 % band\n{_COLUMNS}"
            np.savetxt(partial, table, delimiter=",", fmt="%.6g", header=title, comments="")

    @classmethod
    def read(cls, path: str | Path) -> ShellBand:
        """Read a table that `write` wrote. Raises ValueError if it is a different table."""
        try:
            _, columns, *lines = Path(path).read_text(encoding="utf-8").splitlines()
            if columns != _COLUMNS:
                raise ValueError(columns)
            return cls(*np.array([[float(value) for value in line.split(",")] for line in lines]).T)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is not a table of correlations written by noiseflow; remove it") from error


class ShellSums:
    """Running shell sums of the spectra of a volume and of samples.

    The powers of a whole volume can be estimated from its parts by Welch's method (1967, doi:10.1109/TAU.1967.1161901), if slices
    have weights whose squares sum to 1 over all parts.

    Args:
        volume: (z, y, x).
        shares: (y,) weights of the slices of a part; None for 1.
        height: number of slices of the whole volume, if this is a part of it.
    """

    def __init__(self, volume: Tensor, *, shares: Tensor | None = None, height: int | None = None) -> None:
        shape = volume.shape
        self.shells = min(shape[0], height or shape[1], shape[2]) // 2
        self.shares = None if shares is None else shares.to(volume)[:, None]
        index, times = shells_of(tuple(shape), self.shells)
        inside = np.minimum(index, self.shells + 1)  # one more shell for the corners, which are not used
        self.index = torch.from_numpy(inside.ravel().astype(np.int32)).to(volume.device)
        self.times = torch.from_numpy(times.astype(np.float32)).to(volume.device)
        self.spectrum = self._spectrum(volume)
        self.cross: list[Tensor] = []  # one entry per sample: (shells + 1,)
        self.power: list[Tensor] = []
        self.total = torch.zeros_like(self.spectrum)

    def add(self, sample: Tensor) -> None:
        spectrum = self._spectrum(sample)
        self.cross.append(self._by_shell((spectrum * self.spectrum.conj()).real))
        self.power.append(self._power(spectrum))
        self.total += spectrum

    def powers(self) -> Array:
        """(2·samples + 2, shells + 1) shell sums: of the products of each sample and the volume, of the power of each sample, of
        the volume, and of the mean of the samples. Those of the parts of a volume can be added."""
        mean = self.total / max(1, len(self.power))
        return torch.stack([*self.cross, *self.power, self._power(self.spectrum), self._power(mean)]).numpy()

    def state(self) -> dict[str, Any]:
        return {"cross": self.cross[:], "power": self.power[:], "total": self.total.clone()}

    def load_state(self, state: dict[str, Any]) -> None:
        self.cross, self.power, self.total = state["cross"][:], state["power"][:], state["total"].clone()

    def _spectrum(self, volume: Tensor) -> Tensor:
        spectrum: Tensor = torch.fft.rfftn(volume if self.shares is None else volume * self.shares, norm="ortho")
        return spectrum

    def _power(self, spectrum: Tensor) -> Tensor:
        return self._by_shell(spectrum.abs().square())

    def _by_shell(self, values: Tensor) -> Tensor:
        sums = torch.bincount(self.index, weights=(values * self.times).ravel().double(), minlength=self.shells + 2)
        return sums[: self.shells + 1].cpu()


PARTS = {"std": "standard deviation", "bias": "bias", "wedge": "missing wedge"}
"""Name of each map of error bars → what it is called."""


@described(std="attenuation per voxel", bias="attenuation per voxel", wedge="attenuation per voxel")
@dataclass(frozen=True)
class Uncertainty:
    """Error bars of a volume: its posterior uncertainty, given the images and the regulariser.

    Attributes:
        std: posterior standard deviation, attenuation per voxel.
        bias: posterior mean minus the volume, which is the posterior mode, attenuation per voxel.
        wedge: standard deviation of the error in the missing wedge, see `recon.uncertainty.wedge_std`, attenuation per voxel.
        shells: expected Fourier shell correlation with the truth; None for volumes with fewer than four voxels along an axis.
    """

    std: Volume
    bias: Volume
    wedge: Volume
    num_samples: int
    shells: ShellBand | None = None

    @property
    def parts(self) -> dict[str, Volume]:
        """What each map is called, and the map."""
        return {called: getattr(self, name) for name, called in PARTS.items()}

    def mapped(self, change: Callable[[Volume], Volume]) -> Uncertainty:
        """These error bars with another form of every map."""
        return replace(self, std=change(self.std), bias=change(self.bias), wedge=change(self.wedge))

    def half_width(self, level: float = LEVEL) -> NDArray[np.float32]:
        """Half the width of each voxel's interval, (z, y, x): √(std² + bias² + wedge²) times the normal quantile of `level`."""
        across = np.hypot(np.hypot(self.std.attenuation, self.bias.attenuation), self.wedge.attenuation)
        return across * np.float32(quantile(level))

    def write(self, volume: str | Path) -> dict[str, Path]:
        """Write the error bars next to the file of the volume. Return the paths of the maps and, if known, ``fsc``."""
        paths = error_bar_paths(volume)
        for path, part in zip(paths.values(), self.parts.values(), strict=True):
            part.write(path)
        if self.shells is None:
            return paths
        self.shells.write(shell_band_path(volume))
        return paths | {"fsc": shell_band_path(volume)}


def error_bar_paths(volume: str | Path) -> dict[str, Path]:
    """Paths of the maps of `PARTS` of a volume file, which need not exist."""
    path = Path(volume)
    return {name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in PARTS}


def shell_band_path(volume: str | Path) -> Path:
    """Path of the expected Fourier shell correlation of a volume file, which need not exist."""
    path = Path(volume)
    return path.with_name(f"{path.stem}_fsc.csv")


def quantile(level: float) -> float:
    """Half-width, in standard deviations, of the central interval of a normal distribution with probability `level`. Raises
    ValueError if `level` is not between 0 and 1."""
    if not 0 < level < 1:
        raise ValueError(f"level {level}: give a share between 0 and 1, such as 0.9")
    return float(ndtri(0.5 + level / 2))
