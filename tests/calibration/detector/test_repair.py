"""Repairs of exposures, whatever the mask leaves."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.detector.correlation import LAGS, Correlation
from calibration.detector.repair import band_offsets, refitted, without_bands
from calibration.exposures.frames import ExposurePair
from calibration.registration.aligned import align_pair
from tests.calibration import simulators as sim


def test_offsets_of_rows_are_found_where_the_mask_cuts_half_of_some():
    generator = np.random.default_rng(0)
    z = generator.standard_normal((128, 128)) + 0.5 * generator.standard_normal((128, 1))
    mask = np.ones(z.shape, bool)
    mask[:7, 10:] = False  # one run of 16 left in these rows, so that only the even part has a mean
    mask[90:94, :16] = mask[90:94, 26:] = False
    deviation, error = band_offsets(z[None], mask, axis=2, scene=True)
    assert deviation == pytest.approx(0.5, rel=0.2)
    assert error < 0.1


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize(("frames", "scene"), [(1, True), (4, False), (2, False)])
def test_noise_without_its_bands_keeps_its_variance(axis, frames, scene):
    generator = np.random.default_rng(1)
    noise = generator.standard_normal((frames, 96, 96))
    shape = (frames, 96, 1) if axis == 2 else (frames, 1, 96)
    residual = noise + 0.8 * generator.standard_normal(shape)
    residual -= residual.mean(0) if frames > 1 else 0.0
    kept, deviation = without_bands(residual, residual, np.ones((96, 96), bool), axis=axis, scene=scene)
    assert deviation == pytest.approx(0.8, rel=0.15)
    assert kept.var() == pytest.approx(1 - 1 / frames if frames > 1 else 1.0, rel=0.03)
    alone, none = without_bands(noise, noise, np.ones((96, 96), bool), axis=axis, scene=scene)
    assert none == 0
    np.testing.assert_array_equal(alone, noise)


def test_a_correlation_is_that_of_a_filter_if_it_is_found_short_and_known() -> None:
    short = np.where(np.abs(LAGS).sum(axis=1) == 1, 0.2, 0.0)
    error = np.full(len(LAGS), 0.001)
    blurred = Correlation(np.array(LAGS), short, error, factor=1.8, factor_error=0.1, period=0.0)
    assert blurred.filtered
    assert not replace(blurred, factor_error=1.0).filtered
    assert not replace(blurred, value=np.full(len(LAGS), 0.2)).filtered  # as far as lags are compared
    assert not replace(blurred, value=1e-3 * short).filtered


def test_a_kernel_that_smooths_the_long_exposure_removes_some_of_its_noise():
    generator = np.random.default_rng(2)
    y, x = np.indices((192, 192)) / 192
    light = 60 + 40 * np.sin(5 * x) * np.cos(4 * y)
    pair = align_pair(ExposurePair(*(sim.exposed(generator, ratio * light) for ratio in (1, 4))))
    truth = sim.OFFSET + sim.GAIN * light
    kept, noise = zip(
        *((one.kept, np.var((one.signal - truth)[one.mask])) for one in (pair, refitted(pair))), strict=True
    )
    assert kept[1] < kept[0] / 2
    assert noise[1] / noise[0] == pytest.approx(kept[1] / kept[0], rel=0.2)
