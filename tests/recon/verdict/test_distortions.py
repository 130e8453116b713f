"""Small changes of images, found in what a volume leaves of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.verdict.distortions import distortions
from recon.verdict.image_findings import image_findings
from recon.verdict.residuals import Residuals

Array = NDArray[Any]
TILTS, ROWS, WIDTH = 31, 40, 64


def seen(change: Array, *, first_row: float = 0.0, noise: float = 0.002) -> Residuals:
    """Smooth images that neighbouring tilts share, noisy, each stretched across the axis by so many pixels at its edge."""
    generator = np.random.default_rng(0)
    images = gaussian_filter(generator.normal(size=(TILTS, ROWS, WIDTH)), (4, 3, 3))
    images /= images.std()
    across = (np.arange(WIDTH) - (WIDTH - 1) / 2) / (WIDTH / 2)
    residual = change[:, None, None] * across * np.gradient(images, axis=2) + noise * generator.normal(
        size=images.shape
    )
    height = first_row + np.arange(ROWS)
    return Residuals(
        images + residual, images, residual, np.ones(images.shape, bool), np.linspace(-60, 60, TILTS), height
    )


@pytest.mark.parametrize("first_row", [-ROWS / 2, 230.0])
def test_a_stretch_across_the_axis_is_no_shift_along_it(first_row: float) -> None:
    """Slices far from the middle of the images are judged about their own middle."""
    found = distortions(seen(np.linspace(-1, 1, TILTS), first_row=first_row))
    assert found["magnification"].smooth > 0.2
    assert found["shift along y"].size < 0.1
    assert found["shift across"].size < 0.1


def test_the_ends_of_the_range_are_measured_and_not_counted() -> None:
    """There a volume follows neighbours of one side alone, in good series too."""
    ends = np.zeros(TILTS)
    ends[[0, -1]] = -6, 6
    found, calm = (distortions(seen(change))["magnification"] for change in (ends, 0 * ends))
    assert abs(found.values[0]) > 20 * abs(calm.values).max()
    assert found.size == calm.size
    assert found.trend == calm.trend


@pytest.mark.parametrize(("width", "told"), [(64, True), (256, False)])
def test_one_shift_of_all_images_counts_by_what_it_is_of_their_width(width: int, told: bool) -> None:
    generator = np.random.default_rng(0)
    images = gaussian_filter(generator.normal(size=(TILTS, ROWS, width)), (4, 3, 3))
    images /= images.std()
    residual = 0.3 * np.gradient(images, axis=2) + 0.1 * generator.normal(size=images.shape)
    residuals = Residuals(
        images + residual,
        images,
        residual,
        np.ones(images.shape, bool),
        np.linspace(-60, 60, TILTS),
        np.arange(ROWS),
    )
    _, findings = image_findings(residuals, distortions(residuals))
    assert ("alignment" in {finding.subject for finding in findings}) == told
