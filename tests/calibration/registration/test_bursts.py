"""Bursts: the frame's own part in its mean undone, drift and dose found."""

import numpy as np
import pytest
from scipy import ndimage

from calibration.exposures.frames import Burst
from calibration.registration import align
from calibration.registration.align import register
from calibration.registration.bursts import align_burst

from ..conftest import textured_scene

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


def blinking(generator, number, size=SIZE):
    """Emitters that light up in one frame or another, blurred over some pixels by the optics."""
    frames = []
    for _ in range(number):
        lit = np.where(generator.random((size, size)) < 1e-3, 2500.0, 0.0)
        frames.append(generator.poisson(20 + ndimage.gaussian_filter(lit, 1.3)))
    return Burst(np.stack(frames).astype(float))


def test_many_flat_frames_are_not_all_searched_for_features(monkeypatch):
    searched, frames = [], np.random.default_rng(0).poisson(200.0, (20, 40, 40)).astype(float)

    def search(short, long, **_):
        searched.append(next(index for index, frame in enumerate(frames) if (frame == short).all()))
        return register(short, long)

    monkeypatch.setattr("calibration.registration.bursts.register", search)
    _, report = align_burst(Burst(frames))
    assert searched == [0, 10, 19]
    assert np.isnan(report.drift)


def test_frames_of_a_drifting_lattice_start_from_their_neighbours(monkeypatch):
    generator, searched = np.random.default_rng(0), []
    y, x = np.mgrid[:SIZE, :SIZE]
    waves = [np.sin((x + step) / 1.5) + np.sin((y + 0.3 * x) / 1.7) for step in 0.15 * np.arange(10)]
    frames = np.stack([100 + 2 * generator.poisson(80 + 30 * each) for each in waves]).astype(float)
    guesses = align.correlation_guesses
    monkeypatch.setattr(align, "correlation_guesses", lambda *both: searched.append(0) or guesses(*both))
    _, report = align_burst(Burst(frames))
    assert len(searched) <= 3
    assert report.drift == pytest.approx(0.15 * 10 * np.hypot(1, 0.3), rel=0.02)  # from the mean of the nine others


def test_a_scene_that_blinks_is_refused():
    with pytest.raises(ValueError, match="changes between frames at"):
        align_burst(blinking(np.random.default_rng(0), 6))


def test_a_corner_that_moves_is_left_out_and_the_rest_kept():
    frames, _ = burst([(0, 0)] * 6, [1.0, 0.9, 1.0, 0.95, 1.0, 1.0])
    moved = frames.frames.copy()
    for number, frame in enumerate(moved):
        frame[10:22, 10 + 2 * number : 22 + 2 * number] += 60
    pairs, _ = align_burst(Burst(moved))
    assert not pairs[0].mask[12:20, 14:28].any()
    assert pairs[0].mask[40:-4, 4:-4].mean() > 0.97


@pytest.mark.parametrize("noise", ["uneven", "outliers", "correlated"])
def test_uneven_heavy_tailed_and_correlated_noise_is_no_change_of_the_scene(noise):
    generator = np.random.default_rng(1)
    clean = np.broadcast_to(50 + 20 * np.sin(np.arange(SIZE) / 9), (8, SIZE, SIZE))
    frames = (
        clean
        + {
            "uneven": np.exp(generator.standard_normal((SIZE, SIZE))) * generator.standard_normal(clean.shape),
            "outliers": generator.standard_normal(clean.shape)
            + (generator.random(clean.shape) < 0.01) * generator.exponential(200, clean.shape),
            "correlated": ndimage.gaussian_filter(generator.standard_normal(clean.shape), (0, 0.5, 0.5)),
        }[noise]
    )
    pairs, _ = align_burst(Burst(frames))
    assert pairs[0].counts.restless < 0.02 * SIZE**2
