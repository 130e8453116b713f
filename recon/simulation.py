"""Tilt series of known volumes, with known noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised
from noiseflow.distributions import LatentDistribution
from recon.projector import SliceProjector
from recon.tilt_series import Mode, TiltSeries


class AffineGaussian(nn.Module):
    """Gaussian noise with standard deviation ``floor + slope · signal``: a truth to simulate from, nothing to learn.

    Args:
        floor: standard deviation at zero signal, detector units.
        slope: growth with the signal.
    """

    def __init__(self, floor: float = 0.05, slope: float = 0.2) -> None:
        super().__init__()
        self.floor, self.slope = floor, slope

    def forward(self, signal: Tensor) -> AffineGaussianDistribution:
        return AffineGaussianDistribution(signal, self.floor + self.slope * signal.clamp_min(0))

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Nothing to measure: the noise is known."""


class AffineGaussianDistribution(LatentDistribution):
    """The distribution that `AffineGaussian` returns."""

    def __init__(self, signal: Tensor, scale: Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.scale = signal, scale

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent = (value - self.signal) / self.scale
        return latent, -torch.log(self.scale).expand_as(latent)

    def from_latent(self, latent: Tensor) -> Tensor:
        return self.signal + self.scale * latent

    def _like(self) -> Tensor:
        return self.signal

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.scale**2


def clipped_noise() -> nn.Module:
    """Signal-dependent Gaussian noise clipped to [0, 1], like the synthetic data of Kniesel et al. (CVPR 2022)."""
    return Digitised(AffineGaussian(), step=0.0, low=0.0, high=1.0)


NOISES = {"clipped": clipped_noise}


def clean_tilt_series(
    volume: NDArray[np.floating[Any]],
    tilt_angles: Sequence[float] | NDArray[np.floating[Any]],
    *,
    mode: Mode = "transmission",
    peak: float = 1.5,
    pixel_size: float | None = None,
) -> tuple[TiltSeries, float]:
    """Project a known volume without noise.

    Args:
        volume: (z, y, x) density, any unit.
        tilt_angles: degrees.
        mode: ``transmission`` with unit incident intensity, or ``linear`` with unit gain.
        peak: largest line integral, which sets the unit of attenuation.
        pixel_size: Å.

    Returns:
        The series, and the factor from density to attenuation per voxel.

    Raises:
        ValueError: an empty volume.
    """
    projector = SliceProjector(
        tilt_angles=tilt_angles, depth=volume.shape[0], width=volume.shape[2], dtype=torch.float32
    )
    line_integrals = projector(torch.from_numpy(np.asarray(volume, dtype=np.float32)))
    highest = float(line_integrals.max())
    if not highest > 0:
        raise ValueError("the volume is empty: there is nothing to project")
    line_integrals = line_integrals * (peak / highest)
    signal = torch.exp(-line_integrals) if mode == "transmission" else line_integrals
    return TiltSeries(signal.contiguous().numpy(), np.asarray(tilt_angles), pixel_size, mode), peak / highest


def add_noise(tilt_series: TiltSeries, noise_model: nn.Module, *, seed: int = 0) -> TiltSeries:
    """Draw one noisy reading of every pixel of a clean series."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        noisy = noise_model(torch.from_numpy(tilt_series.images)).sample(generator=generator)
    return TiltSeries(noisy.numpy(), tilt_series.tilt_angles, tilt_series.pixel_size, tilt_series.mode)


def tilt_range(text: str) -> NDArray[np.float64]:
    """Angles of ``START:STOP:STEP`` in degrees, both ends included.

    Raises:
        ValueError: not three numbers, or no angle in the range.
    """
    try:
        start, stop, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"tilts '{text}': give START:STOP:STEP in degrees, such as -60:60:2") from None
    if step == 0 or (stop - start) / step < 0:
        raise ValueError(f"tilts '{text}': the step does not lead from start to stop")
    return np.round(start + step * np.arange(int((stop - start) / step + 1e-6) + 1), 6)
