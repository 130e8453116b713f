"""Error bars of a volume, and their files: ``volume_std.mrc``, ``volume_bias.mrc`` and ``volume_fsc.csv`` next to
``volume.mrc``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from noiseflow.described import described
from recon.series.tilt_series import Volume
from recon.uncertainty.shell_band import ShellBand


@described(std="attenuation per voxel", bias="attenuation per voxel")
@dataclass(frozen=True)
class Uncertainty:
    """Error bars of a volume: its posterior uncertainty, given the images and the regulariser.

    Attributes:
        std: posterior standard deviation, attenuation per voxel.
        bias: posterior mean minus the volume, which is the posterior mode, attenuation per voxel.
        num_samples: number of posterior samples.
        shells: expected Fourier shell correlation with the truth; None for volumes with fewer than four voxels along an axis.
    """

    std: Volume
    bias: Volume
    num_samples: int
    shells: ShellBand | None = None

    def half_width(self, level: float = 0.9) -> NDArray[np.float32]:
        """Half the width of the interval of each voxel, (z, y, x): z·√(std² + bias²), with z the normal quantile of `level`."""
        found: NDArray[np.float32] = np.hypot(self.std.attenuation, self.bias.attenuation) * np.float32(quantile(level))
        return found

    def write(self, volume: str | Path) -> dict[str, Path]:
        """Write the error bars next to the file of the volume. Return the paths ``std``, ``bias`` and, if known, ``fsc``."""
        paths = error_bar_paths(volume)
        self.std.write(paths["std"])
        self.bias.write(paths["bias"])
        if self.shells is None:
            return paths
        self.shells.write(shell_band_path(volume))
        return paths | {"fsc": shell_band_path(volume)}


def error_bar_paths(volume: str | Path) -> dict[str, Path]:
    """Paths ``std`` and ``bias`` of the error bars of a volume file, which need not exist."""
    path = Path(volume)
    return {name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in ("std", "bias")}


def shell_band_path(volume: str | Path) -> Path:
    """Path of the expected Fourier shell correlation of a volume file, which need not exist."""
    path = Path(volume)
    return path.with_name(f"{path.stem}_fsc.csv")


def quantile(level: float) -> float:
    """Half-width, in standard deviations, of the central interval of a normal distribution with probability `level`.

    Raises:
        ValueError: `level` is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level {level}: give a share between 0 and 1, such as 0.9")
    return float(ndtri(0.5 + level / 2))
