"""Hot pixels that dark frames show do not disturb the measurement of the others."""

import numpy as np
import pytest

import calibration
from calibration.pipeline import measure_exposures

from .simulators import exposed, random_scene


def test_hot_pixels_known_from_dark_frames_spread_neither_by_interpolation_nor_by_their_pattern():
    generator = np.random.default_rng(80)
    scene = random_scene(generator, 224, mean=30.0, contrast=1.0)
    dark_current = np.where(generator.random(scene.shape) < 0.002, generator.exponential(600, scene.shape) + 20, 0.0)
    known = {"gain": 1.6, "offset": 120.0, "read_noise": 3.0}
    short, long = (exposed(generator, times * (scene + dark_current), **known, top=65535) for times in (1, 15))
    darks = exposed(generator, np.broadcast_to(dark_current, (4, *scene.shape)), **known)
    found = measure_exposures([calibration.ExposurePair(short, long)], dark=calibration.Burst(darks, calibration=True))
    assert found.verdict.grade == "good", found.verdict.reasons
    assert found.figures.gain.median == pytest.approx(1.6, rel=0.03)
    assert np.array_equal(found.pattern > 10, dark_current > 0)  # for the noise model of raw frames
