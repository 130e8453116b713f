"""Fourier shells against a slow sum, frequency by frequency; structural dissimilarity slice by slice."""

import itertools
import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from recon.metrics.metrics import (
    compare,
    compare_images,
    fourier_shell_correlation,
    matching_line,
    reach_in_words,
    resolution,
)


@pytest.mark.parametrize("shape", [(8, 8, 8), (7, 9, 7), (11, 6)])
def test_every_frequency_is_in_its_nearest_shell(shape):
    first, second = np.random.default_rng(0).normal(size=(2, *shape))
    second += first
    shells = min(shape) // 2
    cross, one, other = np.zeros((3, shells + 1))
    f, g = np.fft.fftn(first), np.fft.fftn(second)
    for index in itertools.product(*map(range, shape)):
        cycles = [(i if i < (n + 1) // 2 else i - n) / n for i, n in zip(index, shape, strict=True)]
        length = sum(c * c for c in cycles) ** 0.5
        nearest = min(range(4 * shells), key=lambda shell: abs(length - shell / (2 * shells)))
        if nearest <= shells:
            cross[nearest] += (f[index] * np.conj(g[index])).real
            one[nearest] += abs(f[index]) ** 2
            other[nearest] += abs(g[index]) ** 2
    frequency, correlation = fourier_shell_correlation(first, second)
    np.testing.assert_allclose(frequency, np.arange(shells + 1) / (2 * shells))
    np.testing.assert_allclose(correlation, cross / np.sqrt(one * other), atol=1e-12)


def test_dissimilarity_is_the_mean_over_slices_and_an_image_is_one_slice():
    volume, other = np.random.default_rng(0).random((2, 5, 12, 14))
    span = other.max() - other.min()
    slices = [structural_similarity(a, b, data_range=span, win_size=7) for a, b in zip(volume, other, strict=True)]
    assert compare(volume, other).dssim == pytest.approx((1 - np.mean(slices)) / 2)
    assert compare(volume[0], other[0]).dssim == pytest.approx(compare(volume[:1], other[:1]).dssim)


def test_errors_are_those_of_their_definitions_in_ranges_of_the_reference():
    reference = np.linspace(10.0, 50.0, 48).reshape(3, 4, 4)
    found = compare(reference + 4.0, reference)
    assert found.mse == pytest.approx(16 / 40**2)
    assert found.psnr == pytest.approx(10 * math.log10(40**2 / 16))
    assert compare(reference, reference).psnr == math.inf
    assert compare(reference, reference).dssim == pytest.approx(0.0, abs=1e-12)
    images = np.stack([reference[0], 3 * reference[0]])
    two = compare_images(images + np.array([0.0, 4.0])[:, None, None], images, scaling="raw")
    assert two.mse == pytest.approx(8 / np.ptp(images[1]) ** 2)


@pytest.mark.parametrize("shape", [(2, 5), (4, 5, 2), (1, 1)])
def test_images_too_small_for_a_window_of_similarity_are_refused(shape):
    image = np.arange(np.prod(shape)).reshape(shape) + 0.0 if np.prod(shape) > 1 else np.zeros(shape)
    with pytest.raises(ValueError, match=r"at least 3 x 3 pixels|flat"):
        compare(image, image)


@pytest.mark.parametrize("shift", [-7.0, 100.0])
def test_scalings_bring_a_result_to_its_reference(shift):
    generator = np.random.default_rng(0)
    truth, noise = generator.normal(shift, 3.0, (4, 9, 8)), generator.normal(0.0, 1.0, (4, 9, 8))
    result = 0.2 * (truth + noise) - 5.0
    design = np.stack([result.ravel(), np.ones(result.size)], 1)
    fitted = design @ np.linalg.lstsq(design, truth.ravel(), rcond=None)[0]
    np.testing.assert_allclose(matching_line(result, truth, "affine")(result).ravel(), fitted, rtol=1e-9)
    ranged = matching_line(result, truth, "min-max")(result)
    assert (ranged.min(), ranged.max()) == pytest.approx((truth.min(), truth.max()))
    np.testing.assert_allclose(np.diff(ranged.ravel()) / np.diff(result.ravel()), np.ptp(truth) / np.ptp(result))
    assert matching_line(result, truth, "raw")(result) is result
    for scaling in ("affine", "min-max"):  # with the gain of the truth, or its offset, already
        np.testing.assert_allclose(matching_line(truth + 2.0, truth, scaling)(truth + 2.0), truth)
        balanced = truth - (truth.mean() if scaling == "affine" else truth.min())
        np.testing.assert_allclose(
            matching_line(3.0 * balanced, balanced, scaling)(3.0 * balanced), balanced, atol=1e-12
        )
    flat = np.full_like(truth, 3.0)
    np.testing.assert_allclose(matching_line(flat, truth, "affine")(flat), truth.mean())
    np.testing.assert_allclose(matching_line(flat, truth, "min-max")(flat), truth.min())


@pytest.mark.parametrize(("size", "window"), [(3, 3), (4, 3), (5, 5), (6, 5), (7, 7), (30, 7)])
def test_small_images_have_a_smaller_window_of_similarity(size, window):
    image, other = np.random.default_rng(0).random((2, size, size))
    span = np.ptp(other)
    similarity = structural_similarity(image, other, data_range=span, win_size=window)
    assert compare(image, other).dssim == pytest.approx((1 - similarity) / 2)


def test_shells_of_equal_empty_and_opposite_arrays():
    volume = np.random.default_rng(0).normal(size=(6, 6, 6))
    frequency, correlation = fourier_shell_correlation(volume, -2 * volume)
    np.testing.assert_allclose(correlation, -1.0)
    assert frequency[-1] == 0.5
    np.testing.assert_array_equal(fourier_shell_correlation(volume, np.zeros_like(volume))[1], 0.0)


def test_reach_is_told_in_cycles_and_as_a_length():
    assert reach_in_words(0.2, 0.143, None) == "stays above 0.143 up to 0.200 cycles per voxel"
    assert reach_in_words(0.25, 0.5, 2.0).endswith("(8 Å)")
    assert reach_in_words(0.25, 0.5, 2.5).endswith("(1 nm)")
    assert reach_in_words(0.25, 0.5, 10.0).endswith("(4 nm)")
    assert "(" not in reach_in_words(0.0, 0.5, 10.0)


def test_a_curve_that_starts_below_has_no_reach_and_the_first_shell_does_not_count():
    frequency = np.linspace(0, 0.5, 6)
    assert resolution(frequency, np.array([0.1, 0.9, 0.9, 0.9, 0.9, 0.9]), 0.5) == 0.5
    assert resolution(frequency, np.array([1.0, 0.4, 0.9, 0.9, 0.2, 0.9]), 0.5) == 0.0
    assert resolution(frequency, np.array([1.0, 0.9, 0.5, 0.3, 0.9, 0.2]), 0.5) == pytest.approx(0.2)
    # what only touches the threshold has not fallen below it
    assert resolution(frequency, np.array([1.0, 0.9, 0.5, 0.9, 0.3, 0.2]), 0.5) == pytest.approx(0.3 + 0.1 * 4 / 6)
    # a quarter of the way down from 0.8 to 0.4 is a quarter of the way from 0.1 to 0.18 cycles per voxel
    assert resolution(np.array([0.0, 0.1, 0.18, 0.3]), np.array([1.0, 0.8, 0.4, 0.0]), 0.7) == pytest.approx(0.12)


def test_the_rest_of_a_spectrum_that_fits_in_memory_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = np.random.default_rng(0).normal(size=(2, 8, 8, 8))
    _, exact = fourier_shell_correlation(first, second)
    size = np.fft.rfftn(first).nbytes
    for memory, digits in ((size, 1e-14), (size - 1, 1e-5)):
        monkeypatch.setattr("noiseflow.io.mapped.IN_MEMORY", memory)
        error = np.abs(fourier_shell_correlation(first, second)[1] - exact).max()
        assert error < digits
    assert error > 1e-10  # beyond, single precision takes half the room on the disk
