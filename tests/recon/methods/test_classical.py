"""SIRT, weighted back-projection and the error measures."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.methods import reconstruct
from recon.metrics.metrics import compare, fourier_shell_correlation, matching_line
from recon.projection.classical import sirt, wbp
from recon.projection.projector import SliceProjector
from recon.series.masks import plausible
from recon.series.tilt_series import VolumeGrid
from recon.simulate.noises import SkewedNoise
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import Acquisition, add_noise, clean_tilt_series, tilt_range


def ball(size, radius):
    position = np.arange(size) - (size - 1) / 2
    distance = np.sqrt(position[:, None] ** 2 + position**2)
    return torch.from_numpy(np.clip(radius - distance + 0.5, 0, 1))[:, None]


@pytest.fixture(scope="module")
def full_circle():
    volume = ball(48, 14.0)
    projector = SliceProjector(tilt_angles=np.arange(0, 180, 2.0), depth=48, width=48, dtype=torch.float64)
    return volume, projector, projector(volume)


def test_sirt_recovers_a_disc(full_circle):
    volume, projector, images = full_circle
    assert (sirt(images, projector, num_iterations=200) - volume).abs().mean() < 0.01


def test_thirty_iterations_are_ten_and_twenty(full_circle):
    _, projector, images = full_circle
    ten = sirt(images, projector, num_iterations=10)
    torch.testing.assert_close(
        sirt(images, projector, num_iterations=20, start=ten),
        sirt(images, projector, num_iterations=30),
        rtol=1e-10,
        atol=1e-12,
    )


def test_back_projection_keeps_absolute_values(full_circle):
    volume, projector, images = full_circle
    result = wbp(images, projector)
    inside = ball(48, 11.0) > 0.99
    assert float(result[inside].mean()) == pytest.approx(1.0, abs=0.005)
    assert float(result[volume < 0.01].mean()) == pytest.approx(0.0, abs=0.02)


def test_back_projection_filter_needs_a_positive_cutoff(full_circle):
    _, projector, images = full_circle
    with pytest.raises(ValueError, match="cutoff"):
        wbp(images, projector, cutoff=0.0)


def test_errors_of_known_arrays():
    reference = np.random.default_rng(0).random((4, 16, 16))
    span = reference.max() - reference.min()
    shifted = compare(reference + 0.1 * span, reference)
    assert shifted.mse == pytest.approx(0.01)
    assert shifted.psnr == pytest.approx(20.0)
    assert compare(3 * reference - 7, reference, scaling="affine").mse == pytest.approx(0, abs=1e-20)
    assert compare(3 * reference - 7, reference, scaling="min-max").mse == pytest.approx(0, abs=1e-20)
    assert compare(reference, reference).psnr == math.inf
    assert compare(reference, reference).dssim == pytest.approx(0, abs=1e-12)


def test_affine_match_is_the_least_squares_fit():
    generator = np.random.default_rng(0)
    result, reference = generator.random((2, 500))
    gain, offset = np.polyfit(result, reference, 1)
    np.testing.assert_allclose(matching_line(result, reference, "affine")(result), gain * result + offset)


def test_shell_correlation_of_equal_and_of_unrelated_volumes():
    first, second = np.random.default_rng(0).normal(size=(2, 32, 32, 32))
    frequency, correlation = fourier_shell_correlation(first, first)
    assert frequency[-1] == 0.5
    np.testing.assert_allclose(correlation, 1)
    assert np.abs(fourier_shell_correlation(first, second)[1][4:]).max() < 0.1


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [(np.zeros((2, 2)), np.zeros((3, 3)), "shapes"), (np.ones((2, 2)), np.ones((2, 2)), "flat")],
)
def test_incomparable_arrays_are_refused(first, second, words):
    with pytest.raises(ValueError, match=words):
        compare(first, second)


def test_shells_are_mostly_vacuum_and_stay_in_the_field_of_view():
    volume = make_phantom("shells", 48, generator=np.random.default_rng(3))
    assert 0.88 < (volume < 0.01).mean() < 0.97
    z, y, x = np.indices(volume.shape) - 23.5
    assert volume[np.sqrt(z**2 + y**2 + x**2) > 24].max() == 0
    with pytest.raises(ValueError, match="choose one of"):
        make_phantom("cube", 48, generator=np.random.default_rng(0))


def test_simulated_series_has_the_peak_and_the_noise_asked_for():
    volume = make_phantom("shells", 24, generator=np.random.default_rng(0))
    clean, unit = clean_tilt_series(volume, [-30.0, 0.0, 30.0], acquisition=Acquisition(None, peak=1.2))
    assert -math.log(clean.images.min()) == pytest.approx(1.2, rel=1e-5)
    assert -math.log(clean.images[1].min()) == pytest.approx(float((unit * volume).sum(0).max()), rel=1e-4)
    noise = add_noise(clean, SkewedNoise(0.1, 0.0), seed=1).images - clean.images
    assert noise.std() == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("text", ["-1e30:1e30:1e29", "0:721:7", "-721:0:7", "-6_0:60:10", "nan:60:1", "0:inf:1"])
def test_tilt_range_refuses_what_are_no_angles(text):
    with pytest.raises(ValueError, match="tilts"):
        tilt_range(text)


@pytest.mark.parametrize("blank", [[2, 3], [0, 5, 10], [1, 6, 11], [2, 7, 12], [3, 8], [4, 9]])
def test_blank_images_among_those_left_out_stop_no_search_for_the_window(blank):
    """As of a closed shutter: whichever views are left out, a volume comes out."""
    volume = make_phantom("shells", 16, generator=np.random.default_rng(0))
    series, _ = clean_tilt_series(volume, tilt_range("-60:60:10"))
    images = series.images.copy()
    images[blank] = 0
    series = replace(series, images=images)
    assert np.isfinite(reconstruct(series, VolumeGrid.of(series), method="wbp").volume.attenuation).all()


def test_tilt_range_includes_both_ends():
    np.testing.assert_allclose(tilt_range("-59.5:59:1.5"), -59.5 + 1.5 * np.arange(80))
    for text in ("1:2", "a:b:c", "0:10:-1", "0:10:0"):
        with pytest.raises(ValueError, match="tilts"):
            tilt_range(text)


@pytest.mark.parametrize(("method", "most"), [("sirt", 0.6), ("wbp", 0.6)])
def test_masked_pixels_cost_little_and_are_never_read(method, most):
    density = make_phantom("particles", 24, generator=np.random.default_rng(0))
    series, unit = clean_tilt_series(density, np.arange(-90, 90, 5.0))
    noisy = add_noise(series, SkewedNoise(0.02), seed=1)
    mask, grid = np.ones(noisy.images.shape, bool), VolumeGrid.of(noisy)
    for tilt in range(len(mask)):
        mask[tilt, 4 + tilt % 12 : 10 + tilt % 12, 6 + tilt % 9 : 12 + tilt % 9] = False
    spoilt = [plausible(replace(noisy, images=np.where(mask, noisy.images, bad), mask=mask)) for bad in (0, 1e6)]
    whole, low, high = (reconstruct(each, grid, method=method).volume.attenuation for each in (noisy, *spoilt))
    np.testing.assert_array_equal(low, high)
    truth = density * unit
    assert compare(low, truth).psnr > compare(whole, truth).psnr - most


def test_rows_that_no_image_shows_take_the_values_beside_them():
    density = np.zeros((16, 12, 16))
    density[5:11, :, 4:9] = 1.0
    series, _ = clean_tilt_series(density, np.arange(-90, 90, 10.0))
    mask = np.ones(series.images.shape, bool)
    mask[:, 5:7] = False
    dead = plausible(replace(series, images=np.where(mask, series.images, 0), mask=mask))
    volume = reconstruct(dead, VolumeGrid.of(dead), method="sirt", num_steps=20).volume.attenuation
    np.testing.assert_allclose(volume[:, 5], volume[:, 4], atol=1e-5)
