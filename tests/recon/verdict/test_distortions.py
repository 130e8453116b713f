"""Small changes of images, found in what a volume leaves of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.verdict.compared import Residuals, coarse_series
from recon.verdict.distortions import displaced_lines, distortions, uneven_vacuum
from recon.verdict.table import CHECKS, TOLERANCES
from tests.independent_scenes import RANGES, independent_series, poisson

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
    assert np.ptp(found["magnification"].values) > 0.4
    assert found["shift along y"].jitter.value < 0.1
    assert found["shift across"].jitter.value < 0.1


def test_the_ends_of_the_range_are_measured_and_not_counted() -> None:
    """There a volume follows neighbours of one side alone, in good series too."""
    ends = np.zeros(TILTS)
    ends[[0, -1]] = -6, 6
    found, calm = (distortions(seen(change))["magnification"] for change in (ends, 0 * ends))
    assert abs(found.values[0]) > 20 * abs(calm.values).max()
    assert found.jitter == calm.jitter


def test_errors_of_correlated_noise_are_those_of_repetitions() -> None:
    generator = np.random.default_rng(0)
    images = gaussian_filter(generator.normal(size=(TILTS, ROWS, WIDTH)), (4, 3, 3))
    noise = gaussian_filter(generator.normal(size=images.shape), (0, 0.8, 0.8))
    used, height = np.ones(images.shape, bool), np.arange(ROWS)
    residuals = Residuals(images + noise, images, noise, used, np.linspace(-60, 60, TILTS), height)
    found = distortions(residuals, pixel=2.0)["shift across"]
    assert np.median(found.errors) == pytest.approx(found.values.std(), rel=0.3)


@pytest.mark.parametrize("axis", [1, 2])
def test_displaced_lines_are_measured_in_pixels(axis: int) -> None:
    right, generator = seen(np.zeros(TILTS), noise=0.3), np.random.default_rng(3)
    images = right.projections if axis == 2 else right.projections.transpose(0, 2, 1)
    shifts = generator.normal(0, 0.6, images.shape[:2])[..., None] * np.gradient(images, axis=2)
    moved = shifts if axis == 2 else shifts.transpose(0, 2, 1)
    wrong = replace(right, images=right.images + moved, residual=right.residual + moved)
    assert displaced_lines(wrong).value == pytest.approx(0.6, rel=0.15)
    assert displaced_lines(right).value < 0.1


@pytest.mark.parametrize("gradient", [0.0, 0.2])
def test_illumination_that_all_images_share_is_named(gradient: float) -> None:
    lines = independent_series("beads", poisson(1), RANGES["±70°/5°"], size=32).clean
    images = np.exp(-lines / lines.max()) * (1 + gradient * np.linspace(-1, 1, 32))
    images = np.random.default_rng(0).poisson(200 * images)
    coarse = coarse_series(TiltSeries(images, RANGES["±70°/5°"]), VolumeGrid(32, 32, 32))
    tolerance = TOLERANCES["uneven illumination"]
    assert (CHECKS["uneven illumination"].of(uneven_vacuum(coarse), tolerance).cost > 1) == (gradient > 0)


@pytest.mark.parametrize("shape", ["wedge along y", "wedge across", "film that ends in the images"])
def test_a_section_is_no_uneven_illumination(shape: str) -> None:
    """It is uneven in all images, as if thinned by ions, but its line integrals grow with the path through it."""
    angles = RANGES["±60°/2°"]
    path = 1 / np.cos(np.radians(angles))[:, None, None]
    uneven = 0.3 * np.linspace(-1, 1, 32)
    lines = path * (np.arange(32)[:, None] < 16) + np.zeros((1, 32, 32))
    if shape.startswith("wedge"):
        lines = path + (uneven if "across" in shape else path * uneven[:, None]) + np.zeros((1, 32, 32))
    images = np.random.default_rng(0).poisson(100 * np.exp(-lines / 2))
    coarse = coarse_series(TiltSeries(images, angles), VolumeGrid(32, 32, 32))
    tolerance = TOLERANCES["uneven illumination"]
    assert CHECKS["uneven illumination"].of(uneven_vacuum(coarse), tolerance).cost < 1
