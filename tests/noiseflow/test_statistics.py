"""The shared statistics against what they estimate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from noiseflow.statistics import (
    block_means,
    neighbour_products,
    rare_chi_squared,
    robust_deviation,
    weighted_line,
    white_regression,
)

GENERATOR = np.random.default_rng(0)


def test_robust_deviation_is_that_of_normal_values_whatever_a_fifth_of_them_is() -> None:
    values = 5 + 2 * GENERATOR.standard_normal(100_000)
    assert robust_deviation(values) == pytest.approx(2, rel=0.01)
    assert robust_deviation(values, 5.0) == pytest.approx(2, rel=0.01)
    values[::5] = 1e6
    assert 2 < robust_deviation(values) < 3


@pytest.mark.parametrize("score", [0.5, 5.0, 8.0])
@pytest.mark.parametrize("freedom", [1, 2, 5, 12])
def test_rare_chi_squared_is_exceeded_as_rarely_as_the_score(score: float, freedom: int) -> None:
    assert stats.chi2.sf(rare_chi_squared(score, freedom), freedom) == pytest.approx(stats.norm.sf(score), rel=1e-9)


@pytest.mark.parametrize("axis", [0, 1, -1])
def test_products_of_neighbours_average_to_what_they_share(axis: int) -> None:
    shared = GENERATOR.standard_normal((300, 1, 1)) + np.zeros((300, 40, 30))
    noisy = shared + GENERATOR.standard_normal(shared.shape)
    expected = np.moveaxis(shared, axis, 0)
    assert neighbour_products(noisy, axis=axis).shape[axis] == shared.shape[axis] - 1
    assert neighbour_products(noisy, axis=axis).mean() == pytest.approx((expected[1:] * expected[:-1]).mean(), abs=0.02)


def test_a_weighted_line_is_that_of_polyfit_and_its_error_is_its_scatter() -> None:
    x, spread = np.linspace(3, 9, 40), np.linspace(0.5, 2, 40)
    y = 7 - 2 * x + spread * GENERATOR.standard_normal((2000, 40))
    slopes = np.array([weighted_line(x, one, spread**-2.0).slope for one in y])
    line = weighted_line(x, y[0], spread**-2.0)
    assert (line.slope, line.intercept) == pytest.approx(np.polyfit(x, y[0], 1, w=1 / spread))
    assert slopes.std() == pytest.approx(line.slope_error, rel=0.05)
    assert np.mean([weighted_line(x, one, spread**-2.0).chi_squared for one in y]) == pytest.approx(1, abs=0.02)


def test_points_at_one_place_have_a_line_without_slope() -> None:
    x = 0.1 + 0.2 * np.array([1.0, 1.0, 1.0]) + np.array([0.0, 1.0, -1.0]) * np.finfo(float).eps
    y = np.array([1.0, 2.0, 6.0])
    line = weighted_line(x, y, np.ones(3))
    assert line.slope == 0
    assert line.intercept == pytest.approx(3.0)
    assert weighted_line(np.array([1.0, 1.0, 1.0 + 1e-9]), y, np.ones(3)).slope == pytest.approx(4.5e9, rel=1e-5)


def test_whites_errors_hold_for_noise_that_grows_with_a_regressor() -> None:
    columns = np.stack([np.ones(400), 1e6 * np.linspace(-1, 1, 400)], 1)
    values = columns @ [1.0, 3e-6] + np.linspace(0.1, 3, 400) * GENERATOR.standard_normal((3000, 400))
    found, errors = white_regression(columns, values)
    assert found.std(0) == pytest.approx(np.sqrt((errors**2).mean(0)), rel=0.05)
    assert found.mean(0) == pytest.approx([1.0, 3e-6], rel=0.02)
    one, _ = white_regression(columns, values[0])
    assert one == pytest.approx(found[0])


@pytest.mark.parametrize("clustered", [False, True])
def test_errors_hold_where_few_values_decide(clustered: bool) -> None:
    group = np.arange(200) // 16
    columns = np.stack([np.exp(-0.5 * ((np.arange(200) - at) / 25) ** 2) for at in (40, 60, 150)] + [np.ones(200)], 1)
    noise = GENERATOR.standard_normal((3000, 200))
    values = np.sqrt(0.5) * (noise + GENERATOR.standard_normal((3000, 13))[:, group]) if clustered else noise
    found, errors = white_regression(columns, values, clusters=group if clustered else None)
    ratio = (found / errors).std(0)
    assert ratio == pytest.approx(1, abs=0.15)


def test_block_means_are_means_of_blocks() -> None:
    images = GENERATOR.random((2, 7, 9))
    means = block_means(images, 3, 2)
    assert means.shape == (2, 2, 4)
    assert means[1, 1, 3] == pytest.approx(images[1, 3:6, 6:8].mean())
