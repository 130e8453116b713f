"""The choice of a noise model is not misled by the noise of the signals."""

import numpy as np
import pytest

import calibration
from calibration.detector.models import attainable, collect_pixels, fit_models

from ..simulators import exposed, random_scene


@pytest.fixture(scope="module")
def pixels():
    """Pixels of a scene that is flat over two thirds of the field, where the signals differ by their noise alone."""
    generator = np.random.default_rng(3)
    scene = random_scene(generator, 160)
    scene = np.maximum(scene, np.quantile(scene, 0.67))
    short, long = (
        exposed(generator, factor * scene / scene.mean(), gain=2.0, read_noise=2.0) for factor in (150, 2000)
    )
    return collect_pixels([calibration.align_pair(calibration.ExposurePair(short, long))])


def test_noisy_signals_of_a_flat_background_ask_for_no_flexible_models(pixels):
    scores = fit_models(pixels, detector=(2.0, 100.0, 2.0))
    assert [score.name for score in scores] == ["gaussian", "poisson", "poisson-gaussian"]


def test_a_wrong_gain_still_leaves_something_to_gain(pixels):
    (shot,) = fit_models(pixels, kinds=["poisson-gaussian"], detector=(1.6, 100.0, 2.0))
    assert attainable(shot.model, pixels) > 0.0025
