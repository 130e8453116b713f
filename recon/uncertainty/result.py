"""Error bars of a volume, and the files they stand in: ``volume_std.mrc``, ``volume_bias.mrc`` and
``volume_fsc.csv`` beside ``volume.mrc``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from noiseflow.described import described
from recon.series.tilt_series import Volume
from recon.uncertainty.shell_band import ShellBand


@described(std="attenuation per voxel", bias="attenuation per voxel")
@dataclass(frozen=True)
class Uncertainty:
    """How far a volume may be from the truth, voxel by voxel, as far as its images and its regulariser tell.

    Attributes:
        std: standard deviation of the volumes that are compatible with the images, attenuation per voxel.
        bias: their mean minus the volume, which is the most likely of them, attenuation per voxel.
        num_samples: what they come from.
        shells: where the Fourier shell correlation with the truth is expected; None of a volume fewer than four voxels thick.
    """

    std: Volume
    bias: Volume
    num_samples: int
    shells: ShellBand | None = None

    def half_width(self, level: float = 0.9) -> NDArray[np.float32]:
        """Half the width of the interval around each voxel, (z, y, x): z·√(std² + bias²), z the normal quantile of `level`."""
        found: NDArray[np.float32] = np.hypot(self.std.attenuation, self.bias.attenuation) * np.float32(quantile(level))
        return found

    def write(self, volume: str | Path) -> dict[str, Path]:
        """Write all beside the file of the volume; returns their paths, ``std``, ``bias`` and ``fsc`` where it is known."""
        paths = error_bar_paths(volume)
        self.std.write(paths["std"])
        self.bias.write(paths["bias"])
        if self.shells is None:
            return paths
        self.shells.write(shell_band_path(volume))
        return paths | {"fsc": shell_band_path(volume)}


def error_bar_paths(volume: str | Path) -> dict[str, Path]:
    """Where the error bars of the volume of a file stand, ``std`` and ``bias``, whether they are there or not."""
    path = Path(volume)
    return {name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in ("std", "bias")}


def shell_band_path(volume: str | Path) -> Path:
    """Where the expected Fourier shell correlation of the volume of a file stands, whether it is there or not."""
    path = Path(volume)
    return path.with_name(f"{path.stem}_fsc.csv")


def quantile(level: float) -> float:
    """Standard deviations on either side that hold the share `level` of a normal distribution.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level {level}: give a share between 0 and 1, such as 0.9")
    return float(norm.ppf(0.5 + level / 2))
