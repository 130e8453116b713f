"""Exposures of a scene that moved by parts of a pixel, rendered from continuous functions, so that the motion is exact."""

import numpy as np
import pytest
from scipy import ndimage

from calibration.exposures.frames import ExposurePair
from calibration.pipeline import measure_exposures
from calibration.registration.aligned import align_pair

from .. import simulators as sim


def spots(seed, size, *, number=40, widths=(3.0, 9.0), shift=(0.0, 0.0)):
    """Gaussian spots on a black background with a maximum of about 1, (size, size), moved by `shift` (x, y), pixels."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size].astype(float)
    image = np.zeros((size, size))
    for _ in range(number):
        (at_x, at_y), width = generator.uniform(0, size, 2), generator.uniform(*widths)
        square = (x - at_x - shift[0]) ** 2 + (y - at_y - shift[1]) ** 2
        image += generator.uniform(0.2, 1.0) * np.exp(-square / (2 * width**2))
    return image / 2


def moved_pair(
    seed, size, *, electrons, ratio=10.0, shift=(2.3, -1.6), pattern=0.0, number=40, widths=(3.0, 9.0), **rest
):
    """A pair from one detector whose pixels' gains have a relative deviation of `pattern`."""
    generator = np.random.default_rng(100 + seed)
    gains = 1 + pattern * generator.standard_normal((size, size))
    spot = {"number": number, "widths": widths}
    scenes = spots(seed, size, **spot), ratio * spots(seed, size, shift=shift, **spot)
    return ExposurePair(*(sim.exposed(generator, electrons * one * gains, **rest) for one in scenes))


@pytest.mark.parametrize("shift", [(0.5, 0.7), (2.3, -1.6), (5.0, 3.0)])
def test_gains_of_pixels_are_found_where_the_scene_moved_over_them(shift):
    ratios = []
    for seed in range(6):
        aligned = align_pair(moved_pair(seed, 192, electrons=1500.0, shift=shift, pattern=0.04))
        signal, (deviation, share, _) = aligned.signal[aligned.mask], aligned.gains
        assert 0.02 < share < 0.9
        shot, read = sim.GAIN * (signal - sim.OFFSET).clip(0), (sim.GAIN * sim.READ_NOISE) ** 2
        own = aligned.kept * (shot / 10 + read / 100)
        total = aligned.total_variance(signal).mean() / (shot + read + own).mean()
        ratios.append((deviation / 0.04, total, aligned.signal_variance(signal).mean() / own.mean()))
    assert np.mean(ratios, axis=0) == pytest.approx(
        [1, 1, 1], abs=0.25
    )  # with them, the noise of the signal would be twofold
    assert np.mean(ratios, axis=0)[:2] == pytest.approx([1, 1], abs=0.05)


@pytest.mark.parametrize("shift", [(0.4, 0.6), (2.3, -1.6)])
def test_equal_pixels_have_no_gains_to_remove(shift):
    pair = moved_pair(2, 192, electrons=1500.0, shift=shift)
    aligned = align_pair(pair)
    assert not aligned.gains
    assert np.array_equal(aligned.short, pair.short)


def test_reduced_counts_stay_rounded_and_darkness_as_it_was():
    pair = moved_pair(3, 192, electrons=1500.0, pattern=0.04, number=12)
    aligned = align_pair(pair)
    assert np.array_equal(aligned.short, np.round(aligned.short))
    dark = aligned.mask & (aligned.level < sim.OFFSET + 1)
    assert dark.mean() > 0.05
    assert np.array_equal(aligned.short[dark], pair.short[dark])


def test_clipped_darkness_of_a_long_exposure_that_is_interpolated_is_left_out():
    """Noise of 6 counts, 10 counts above 0: a quarter of the dark pixel values would be clipped without an offset."""
    used = {}
    for shift in ((0.0, 0.0), (3.5, 1.5)):
        pair = moved_pair(4, 256, electrons=80.0, shift=shift, offset=6.0, number=30)
        aligned = align_pair(pair)
        dark = aligned.registration.warp(spots(4, 256, number=30, shift=shift))[0] < 1e-3
        assert not (aligned.mask & dark).any()
        used[shift] = aligned.mask.mean()
    assert used[3.5, 1.5] > 0.5 * used[0.0, 0.0]


def test_noise_of_few_bright_pixels_on_a_dark_background_is_not_cut_off():
    """Six standard deviations of all pixels are less than two of the bright ones."""
    ratios = []
    for seed in range(5):
        spot = {"number": 4, "widths": (4.0, 6.0), "read_noise": 0.5}
        aligned = align_pair(moved_pair(seed, 192, electrons=400.0, **spot))
        # both lines are too flat, as their signals are noisy
        share = aligned.kept / 10 / (1 + aligned.kept / 10)
        ratios.append(aligned.signal_variance.rate / (share * aligned.total_variance.rate))
    assert np.mean(ratios) > 0.83


@pytest.mark.slow
@pytest.mark.parametrize("pattern", [0.0, 0.03])
def test_gain_of_a_scene_that_moved_is_right_or_the_pattern_is_named(pattern):
    found = measure_exposures([moved_pair(5, 384, electrons=400.0, pattern=pattern, number=120)])
    gain = found.figures.gain
    assert gain.q05 < sim.GAIN < gain.q95
    assert gain.median == pytest.approx(sim.GAIN, rel=0.04)
    assert ("fixed pattern" in found.verdict.subjects) == (pattern > 0)
    assert found.verdict.grade == ("doubtful" if pattern else "good")


@pytest.mark.slow
def test_residuals_without_the_gains_do_not_correlate():
    found = measure_exposures([moved_pair(6, 384, electrons=2000.0, pattern=0.03, number=120)])
    assert found.pairs[0].gains
    assert not found.correlation.found
    assert not found.repairs.refitted


@pytest.mark.slow
def test_a_pattern_that_is_most_of_the_variance_is_no_full_well():
    """Its removal leaves an error as large as the noise of bright pixels."""
    found = measure_exposures([moved_pair(2, 256, electrons=1500.0, pattern=0.1, number=60)])
    assert found.verdict.subjects[0] == "fixed pattern"
    assert "saturation" not in found.verdict.subjects
    assert found.verdict.grade == "doubtful"
    assert found.figures.gain.q05 < sim.GAIN < found.figures.gain.q95


@pytest.mark.slow
def test_intervals_contain_the_uncertainty_of_the_gains_of_pixels():
    missed = np.zeros(3)
    for seed in range(10):
        generator = np.random.default_rng(seed)
        scene = sim.random_scene(generator, 272)
        gain = sim.GAIN * (1 + 0.03 * generator.standard_normal((256, 256)))
        moved = ndimage.shift(scene, (-3.4, -2.7)).clip(0)
        short, long = (sim.exposed(generator, one[:256, :256], gain=gain) for one in (scene, 16 * moved))
        found = measure_exposures([ExposurePair(short, long, exposure_ratio=16.0)])
        assert found.verdict.subjects[0] == "fixed pattern"
        figures = found.figures.gain, found.figures.offset, found.figures.read_noise
        for index, (one, truth) in enumerate(zip(figures, (sim.GAIN, sim.OFFSET, sim.READ_NOISE), strict=True)):
            missed[index] += one is not None and not one.q05 < truth < one.q95
    assert missed.max() <= 2  # of 10 intervals of 90 %
