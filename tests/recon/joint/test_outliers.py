"""Outliers that add to any signal, as cosmic rays and X-rays do, neither dim nor brighten the volume."""

import numpy as np
import pytest

from recon import reconstruct
from tests.independent_scenes import independent_series


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "seed"), [("smooth_blobs", 1), ("needle_with_precipitates", 2)])
def test_outliers_change_neither_mass_nor_offset(scene: str, seed: int) -> None:
    made = independent_series(scene, "outliers", "±60°/2°")
    found = reconstruct(made.series, seed=seed)
    assert found.choices["noise model"] == "GaussianWithOutliers"
    assert found.volume.attenuation.sum() / made.truth.sum() == pytest.approx(
        1, abs=0.03
    )  # 1.15 if outliers grow with the noise
    # 5 counts, and 2 % of outliers with a mean of 80
    assert found.choices["offset"] == pytest.approx(6.6, abs=0.3)


@pytest.mark.slow
def test_vacuum_that_outliers_hide_is_found_in_the_chosen_volume() -> None:
    """It fixes the offset: a sparse gyroid's mass was 1.09 of the true one without it."""

    def outliers(clean: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, float]:
        hit = random.random(clean.shape) < 0.05
        noise = random.normal(0, 1.5, clean.shape) + hit * random.normal(0, 15, clean.shape)
        return random.poisson(30 * clean) + 3 + noise, 30.0

    made = independent_series("gyroid", outliers, "±60°/2°")
    found = reconstruct(made.series)
    assert found.volume.attenuation.sum() / made.truth.sum() == pytest.approx(1, abs=0.03)
