"""The coarse start lies where the volume lies, whatever binning leaves over at the edge."""

from __future__ import annotations

import numpy as np
import torch

from recon.joint.coarse_start import coarse_start
from recon.projection.image_formation import Transmission
from recon.series.tilt_series import VolumeGrid
from recon.simulate.simulation import clean_tilt_series


def test_the_middle_stays_in_the_middle_where_pixels_are_left_over() -> None:
    """51 pixels make 12 of four and leave three, on one side."""
    place = np.arange(51) - 25.0
    ball = np.exp(-(place[:, None, None] ** 2 + place[:, None] ** 2 + place**2) / 128).astype(np.float32)
    series, _ = clean_tilt_series(ball, np.arange(-60, 61, 10.0))
    generator = torch.Generator().manual_seed(0)
    volume = coarse_start(
        series, Transmission(1.0), VolumeGrid.of(series), num_steps=80, generator=generator
    ).clamp_min(0)
    along_x = volume.sum((0, 1))
    middle = float((along_x * (torch.arange(len(along_x)) - (len(along_x) - 1) / 2)).sum() / along_x.sum())
    assert abs(middle) < 0.3  # 0.8 coarse voxels, three fine ones, with the remainder on the wrong side
