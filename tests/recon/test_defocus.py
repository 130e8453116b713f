"""Defocus blurs what is far from the tilt axis at high tilts, keeps the mean, and is the Gaussian it says."""

import numpy as np
import pytest

from recon.defocus import defocus_widths, defocused


def reference(image, widths):
    """Every pixel by itself, straight from the definition, on an image whose edges are empty."""
    rows, columns = np.indices(image.shape)
    result = np.array(image, dtype=np.float64)
    for y, u in np.ndindex(image.shape):
        if widths[u] >= 0.25:
            weights = np.exp(-((rows - y) ** 2 + (columns - u) ** 2) / (2 * widths[u] ** 2))
            result[y, u] = (weights * image).sum() / weights.sum()
    return result


def test_blur_is_the_gaussian_of_its_column():
    image = np.zeros((41, 61), np.float32)
    image[15:26, 12:50] = np.random.default_rng(0).random((11, 38))
    widths = defocus_widths(61, 60.0, 0.05)
    found, expected = defocused(image, 60.0, 0.05), reference(image, widths)
    inside = (slice(12, 29), slice(12, 50))
    np.testing.assert_allclose(found[inside], expected[inside], atol=2e-4)
    assert np.abs(found - image).max() > 0.3


def test_axis_and_untilted_images_stay_sharp():
    image = np.random.default_rng(1).random((16, 33)).astype(np.float32)
    np.testing.assert_array_equal(defocused(image, 0.0, 0.5), image)
    blurred = defocused(image, 70.0, 0.1)
    np.testing.assert_array_equal(blurred[:, 16], image[:, 16])
    sharpness = np.abs(np.diff(blurred, axis=0)).mean(0)
    assert sharpness[[0, -1]].max() < 0.5 * sharpness[15:18].min()


def test_flat_images_stay_flat_and_mirrored_tilts_are_alike():
    flat = np.full((12, 20), 3.0, np.float32)
    np.testing.assert_allclose(defocused(flat, 65.0, 0.8), flat, rtol=1e-6)
    image = np.random.default_rng(2).random((12, 20)).astype(np.float32)
    np.testing.assert_allclose(defocused(image[:, ::-1], -50.0, 0.2), defocused(image, 50.0, 0.2)[:, ::-1], rtol=1e-5)


def test_negative_strength_is_refused():
    with pytest.raises(ValueError, match="zero or more"):
        defocus_widths(8, 10.0, -1.0)
