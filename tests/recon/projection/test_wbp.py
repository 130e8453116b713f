"""Weighted back-projection against a slow sum by its formulas."""

import math

import numpy as np
import pytest
import torch

from recon.projection.classical import WINDOWS, angular_shares, wbp
from recon.projection.projector import SliceProjector

WIDTH = 24
WINDOW_OF_SHARE = {  # as signal-processing textbooks print them, of frequency over cutoff
    "ramp": lambda s: 1.0,
    "shepp-logan": lambda s: 1.0 if s == 0 else math.sin(math.pi * s / 2) / (math.pi * s / 2),
    "cosine": lambda s: math.cos(math.pi * s / 2),
    "hamming": lambda s: 0.54 + 0.46 * math.cos(math.pi * s),
    "hann": lambda s: math.cos(math.pi * s / 2) ** 2,
}


def kernel(n):
    """Ramachandran and Lakshminarayanan's kernel at n pixels."""
    if n == 0:
        return 0.25
    return -1 / (math.pi * n) ** 2 if n % 2 else 0.0


def filtered(image, window="ramp", cutoff=1.0):
    """One view of one slice, filtered: back-projected through one voxel of depth, it stands for half a circle."""
    projector = SliceProjector(tilt_angles=[0.0], depth=1, width=image.shape[-1], dtype=torch.float64)
    return (wbp(image.reshape(1, 1, -1), projector, window=window, cutoff=cutoff) / math.pi).reshape(-1)


def test_the_ramp_is_the_kernel_summed_over_the_image_alone():
    """No wrap-around: what lies at one edge does not reach the other by the back door."""
    image = torch.rand(WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = [sum(float(image[j]) * kernel(i - j) for j in range(WIDTH)) for i in range(WIDTH)]
    np.testing.assert_allclose(filtered(image), expected, atol=1e-12)


def test_the_windows_are_all_there():
    assert set(WINDOWS) == set(WINDOW_OF_SHARE)


@pytest.mark.parametrize("cutoff", [1.0, 0.6])
@pytest.mark.parametrize("window", sorted(WINDOWS))
def test_windows_weigh_every_frequency_as_their_formulas_say(window, cutoff):
    image = torch.rand(WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    size = 64
    ramp = [
        sum(kernel(min(n, size - n)) * math.cos(2 * math.pi * k * n / size) for n in range(size)) for k in range(size)
    ]
    expected = np.zeros(WIDTH, complex)
    for k in range(size):
        share = min(k, size - k) / (size / 2) / cutoff
        if share > 1:
            continue
        coefficient = sum(float(image[j]) * np.exp(-2j * math.pi * k * j / size) for j in range(WIDTH))
        wave = np.exp(2j * math.pi * k * np.arange(WIDTH) / size)
        expected += coefficient * ramp[k] * WINDOW_OF_SHARE[window](share) * wave / size
    np.testing.assert_allclose(filtered(image, window, cutoff), expected.real, atol=1e-10)


def test_tilts_share_half_a_circle_and_no_more():
    assert angular_shares(np.arange(0, 180, 2.0)).sum() == pytest.approx(math.pi)
    assert angular_shares(np.arange(0, 360, 2.0)).sum() == pytest.approx(math.pi)
    limited = angular_shares(np.arange(-60, 61, 2.0))
    np.testing.assert_allclose(limited, np.deg2rad(2))
    np.testing.assert_allclose(angular_shares(np.array([7.0, 7.0])), math.pi / 2)
    np.testing.assert_allclose(np.rad2deg(angular_shares(np.array([7.0, 17.0]))), [10, 10])
    # a direction that rounding put on the other side of the turn is that of zero
    np.testing.assert_allclose(np.rad2deg(angular_shares(np.array([0.0, -1e-12, 60.0, 120.0]))), [30, 30, 60, 60])
    uneven = np.array([-30.0, 0.0, 10.0, 10.0, 50.0])
    np.testing.assert_allclose(np.rad2deg(angular_shares(uneven)), [30, 20, 12.5, 12.5, 40])


def test_a_disc_seen_twice_around_keeps_its_values():
    position = np.arange(32) - 15.5
    disc = torch.from_numpy(np.clip(10.5 - np.hypot(position[:, None], position), 0, 1))[:, None]
    projector = SliceProjector(tilt_angles=np.arange(0, 360, 3.0), depth=32, width=32, dtype=torch.float64)
    inside = torch.from_numpy(np.hypot(position[:, None], position) < 7)[:, None]
    assert float(wbp(projector(disc), projector)[inside].mean()) == pytest.approx(1.0, abs=0.01)
