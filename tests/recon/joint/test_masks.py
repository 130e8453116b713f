"""What is masked never reaches a fitted volume: other values there give the same volume, to the last bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.joint.coarse_start import coarse_start
from recon.methods import reconstruct
from recon.projection.image_formation import Transmission
from recon.series.first_guess import estimate_response
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series


def masked(value: float) -> TiltSeries:
    """A series of which a patch of every image is masked and holds `value`."""
    density = make_phantom("particles", 16, generator=np.random.default_rng(0))
    acquisition = ACQUISITIONS["low-dose"]
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 6.0), acquisition=acquisition)
    noisy = add_noise(clean, acquisition.noise(), seed=1)
    mask = np.ones(noisy.images.shape, bool)
    mask[:, 5:9, 6:11] = False
    return replace(noisy, images=np.where(mask, noisy.images, np.float32(value)), mask=mask)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("method", ["l2", pytest.param("joint", marks=pytest.mark.slow)])
def test_values_under_the_mask_do_not_change_the_volume(method: str) -> None:
    low, high = (masked(value) for value in (2.0, 3.0))
    volumes = [
        reconstruct(series, VolumeGrid.of(series), method=method, weight=1.0, num_steps=12).volume.attenuation
        for series in (low, high)
    ]
    np.testing.assert_array_equal(*volumes)


@pytest.mark.usefixtures("one_thread")
def test_values_under_the_mask_do_not_change_the_coarse_start() -> None:
    found = []
    for series in (masked(2.0), masked(3.0)):
        response, generator = Transmission(1.5), torch.Generator().manual_seed(0)
        volume, _ = coarse_start(series, response, VolumeGrid.of(series), num_steps=8, generator=generator)
        found.append((volume, response(torch.zeros(1)).detach()))
    torch.testing.assert_close(*found, rtol=0, atol=0)


def test_the_coarse_start_follows_the_pixels_in_use_alone() -> None:
    """Squares as large as the coarse pixels are masked: what stands in for them must not pull the volume."""
    density = make_phantom("particles", 32, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 6.0), acquisition=ACQUISITIONS["low-dose"])
    squares = np.random.default_rng(1).random((clean.num_tilts, 8, 8)) < 0.4
    mask = ~np.kron(squares, np.ones((1, 4, 4), dtype=bool))
    whole, part = (started(series) for series in (clean, replace(clean, mask=mask)))
    assert float((part - whole).square().mean().sqrt()) < 0.3 * float(
        whole.square().mean().sqrt()
    )  # 0.58 without the mask


def started(series: TiltSeries) -> torch.Tensor:
    options = {"num_steps": 80, "generator": torch.Generator().manual_seed(0)}
    return coarse_start(series, estimate_response(series), VolumeGrid.of(series), **options)[0]


def test_the_intensity_of_the_coarse_start_is_that_of_the_pixels_in_use_alone() -> None:
    """A masked stripe, for which the mean stands in, must not dim or brighten the beam."""
    density = make_phantom("shells", 51, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 10.0))
    mask = np.ones(clean.images.shape, dtype=bool)
    mask[:, :, 20:36] = False
    response, generator = Transmission(1.0), torch.Generator().manual_seed(0)
    series = replace(clean, mask=mask)
    coarse_start(series, response, VolumeGrid.of(series), num_steps=100, generator=generator)
    assert float(response(torch.zeros(1)).detach()) == pytest.approx(1, abs=0.05)  # 1.30 where the stripe counts
