"""Bursts: the frame's own part in its mean undone, drift and dose found."""

import numpy as np
import pytest

from calibration.bursts import align_burst
from calibration.exposures import Burst

from .conftest import textured_scene

SIZE = 128


def burst(shifts, doses, *, seed=0, electrons=60.0):
    """Frames of one scene, displaced and dosed as told, with their clean signals."""
    generator = np.random.default_rng(seed)
    scene = textured_scene(generator, SIZE)
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    clean = [
        dose * electrons * (0.1 + scene(x + dx, y + dy).clip(0)) for (dx, dy), dose in zip(shifts, doses, strict=True)
    ]
    frames = [np.round(100 + 2 * (generator.poisson(rate) + generator.standard_normal(rate.shape))) for rate in clean]
    return Burst(np.stack(frames)), 100 + 2 * np.stack(clean)


@pytest.mark.parametrize("number", [2, 4])
def test_observation_scatters_as_one_frame(number):
    frames, clean = burst([(0, 0)] * number, [1.0] * number)
    pairs, report = align_burst(frames)
    truth = np.mean((frames.frames - clean) ** 2)
    raw = np.mean([np.mean((p.short - p.signal)[p.mask] ** 2) for p in pairs])
    corrected = np.mean([np.mean((p.observation - p.signal)[p.mask] ** 2) for p in pairs])
    assert raw == pytest.approx(truth * number / (number - 1), rel=0.03)
    assert corrected == pytest.approx(truth, rel=0.03)
    assert not report.drifting
    assert not report.fading


def test_drift_is_found_and_undone():
    shifts = [(0.0, 0.0), (1.1, -0.4), (2.3, -0.9), (3.2, -1.6)]
    frames, clean = burst(shifts, [1.0] * 4)
    pairs, report = align_burst(frames)
    assert report.drifting
    assert report.drift == pytest.approx(np.hypot(3.2, 1.6), rel=0.4)
    left = np.mean([np.mean((p.observation - p.signal)[p.mask] ** 2) for p in pairs])
    assert left == pytest.approx(np.mean((frames.frames - clean) ** 2), rel=0.1)


def test_dose_change_is_found():
    frames, _ = burst([(0, 0)] * 4, [1.0, 0.97, 0.94, 0.91])
    _, report = align_burst(frames)
    assert report.fading
    assert np.all(np.diff(report.dose) < 0)
    assert report.dose[0] / report.dose[3] == pytest.approx(1.13, abs=0.03)


def test_flat_frames_have_no_drift_to_tell():
    frames = Burst(np.random.default_rng(0).poisson(500, (3, 64, 64)).astype(float))
    pairs, report = align_burst(frames)
    assert np.isnan(report.drift)
    assert not report.drifting
    assert np.mean([np.var((p.observation - p.signal)[p.mask]) for p in pairs]) == pytest.approx(500, rel=0.05)
