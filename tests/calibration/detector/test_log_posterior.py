"""The posterior's density is that of its priors: flat where it says so, with the Jacobian of its own coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibration.detector.levels import Levels, collect_cells, collect_levels
from calibration.detector.likelihood import LevelMasses
from calibration.detector.log_posterior import (
    READ_NOISE_RANGE,
    SHARE_OF_DEVIATION,
    LogPosterior,
    _climb,
    _start,
    maximum_likelihood,
)
from calibration.detector.posterior import NINETY, DetectorPosterior

from .test_detector import cells, readings


@pytest.fixture(scope="module")
def levels():
    electrons = np.random.default_rng(2).gamma(2.0, 20.0, 20_000)
    return [collect_levels([readings(np.random.default_rng(3), electrons, step=1.0)])]


SETS = np.array([[2.0, 100.0, 1.5], [1.9, 96.0, 1.2], [2.1, 103.0, 2.5]])


def test_the_offset_is_flat_though_its_coordinate_is_the_log_variance(levels):
    posterior = LogPosterior(levels)
    assert not posterior.by_offset
    coordinates = posterior.coordinates(*SETS.T)
    np.testing.assert_allclose(np.stack(posterior.parameters(coordinates), -1), SETS, rtol=1e-9)
    step = np.array([0.0, 1e-5, 0.0])
    upper, lower = (posterior.parameters(coordinates + sign * step)[1] for sign in (1, -1))
    jacobian = np.log(np.abs(upper - lower) / 2e-5)
    np.testing.assert_allclose(posterior(coordinates), posterior.likelihood(*SETS.T) + jacobian, rtol=1e-7)


def test_a_measured_offset_is_a_normal_prior(levels):
    posterior = LogPosterior(levels, offset=(99.0, 0.7))
    coordinates = posterior.coordinates(*SETS.T)
    prior = stats.norm.logpdf(SETS[:, 1], 99.0, 0.7) - stats.norm.logpdf(99.0, 99.0, 0.7)
    np.testing.assert_allclose(posterior(coordinates), posterior.likelihood(*SETS.T) + prior, rtol=1e-9)


def test_the_variance_of_dark_frames_is_a_normal_prior_of_read_noise(levels):
    without, known = (LogPosterior(levels, offset=(99.0, 0.7, *more)) for more in ((), (8.0, 0.5)))
    coordinates = known.coordinates(*SETS.T)
    prior = -0.5 * (((SETS[:, 0] * SETS[:, 2]) ** 2 - 8.0) / 0.5) ** 2
    np.testing.assert_allclose(known(coordinates), without(coordinates) + prior, rtol=1e-9)


def test_nothing_outside_the_priors_is_possible(levels):
    posterior = LogPosterior(levels, offset=(99.0, 0.7))
    low, high = READ_NOISE_RANGE
    sets = np.array([[2.0, 99.0, 0.99 * low], [2.0, 99.0, 1.01 * high], [2.0, posterior.brightest, 1.5]])
    assert np.isneginf(posterior(posterior.coordinates(*sets.T))).all()
    assert np.isfinite(posterior(posterior.coordinates(2.0, 99.0, 1.01 * low))).all()


def test_codes_coarser_than_electrons_leave_no_read_noise_that_would_show_single_ones(levels):
    """A posterior of 8-bit frames at 0.2 counts per electron was a field of peaks, hard to sample, where they keep step."""
    posterior = LogPosterior(levels, offset=(99.0, 0.7))
    below, above = (posterior.coordinates(0.25, 99.0, read_noise) for read_noise in (0.39, 0.41))
    assert np.isneginf(posterior(below)).all()
    assert np.isfinite(posterior(above)).all()


def dim_pair(rate: float = 40.0, offset: float = 100.0) -> list[Levels]:
    """Short exposures beside signals that a longer one of the same setting gave, so that they share their offset."""
    electrons = np.random.default_rng(0).gamma(4.0, rate / 4, 20_000)
    one = cells(np.random.default_rng(1), electrons, read_noise=2.0, offset=offset)
    return [collect_cells([one], guess=(2.0, offset, 2.0))]


def residuals() -> list[Levels]:
    generator = np.random.default_rng(4)
    return [collect_levels([readings(generator, generator.gamma(2.0, 20.0, 20_000), step=1.0)])]


@pytest.mark.parametrize("offset", [None, (99.0, 0.7)])
@pytest.mark.parametrize("make", [residuals, dim_pair])
def test_coordinates_are_the_logarithms_and_come_back(make, offset):
    posterior = LogPosterior(make(), offset)
    assert posterior.by_offset == (offset is not None or make is dim_pair)
    coordinates = posterior.coordinates(*SETS.T)
    np.testing.assert_allclose(np.stack(posterior.parameters(coordinates), -1), SETS, rtol=1e-9)
    gain, level, read_noise = SETS.T
    variance = gain * (posterior.reference - level) + (gain * read_noise) ** 2
    second = level if posterior.by_offset else np.log(variance)
    np.testing.assert_allclose(coordinates, np.stack([np.log(gain), second, np.log(read_noise)], -1), rtol=1e-12)


def test_rows_outside_the_priors_do_not_change_the_others():
    posterior = LogPosterior(residuals())
    inside = posterior.coordinates(*SETS.T)
    outside = np.array([[51.0, inside[0, 1], 0.3], [-51.0, inside[0, 1], 0.3], [0.7, inside[0, 1], 1e3]])
    found = posterior(np.concatenate([outside, inside]))
    assert np.isneginf(found[:3]).all()
    np.testing.assert_allclose(found[3:], posterior(inside), rtol=1e-12)
    low, high = READ_NOISE_RANGE
    for edge, step in ((low, 1e-3), (high, -1e-3)):
        sets = posterior.coordinates(*np.array([[2.0, 100.0, edge * np.exp(by)] for by in (step, -step)]).T)
        np.testing.assert_array_equal(np.isfinite(posterior(sets)), [True, False], err_msg=str(edge))
    too_bright = np.array([[np.log(2.0), np.log(10.0), np.log(20.0)]])
    assert posterior.parameters(too_bright)[1][0] > posterior.brightest
    assert np.isneginf(posterior(too_bright)).all()


def test_a_likelihood_that_cannot_be_computed_is_that_of_the_impossible(levels, monkeypatch):
    posterior = LogPosterior(levels)
    coordinates = posterior.coordinates(*SETS.T)
    monkeypatch.setattr(posterior, "likelihood", lambda *parameters: np.array([np.nan, 1.0, np.nan]))
    assert np.isneginf(posterior(coordinates)).tolist() == [True, False, True]


CASES = {
    "lit": (lambda: [collect_levels([readings(np.random.default_rng(3), ELECTRONS, step=1.0)])], None),
    "offset measured": (residuals, (100.0, 0.5)),
    "dark frames": (residuals, (100.0, 0.5, 9.0, 0.1)),
    "offset in common": (dim_pair, None),
    "dim": (lambda: dim_pair(3.0, 300.0), None),
}
ELECTRONS = np.random.default_rng(2).gamma(2.0, 20.0, 20_000)


@pytest.mark.parametrize("name", CASES)
def test_the_maximum_found_is_the_maximum_and_the_search_begins_near_it(name):
    make, offset = CASES[name]
    posterior = LogPosterior(make(), offset)
    final, best, _ = maximum_likelihood(posterior)
    highest = float(final(best)[0])
    generator = np.random.default_rng(0)
    size = np.array([0.02, 1.0 if final.by_offset else 0.02, 0.1])
    around = best + generator.standard_normal((300, 3)) * size * generator.choice([0.03, 0.3, 1.0], (300, 1))
    # the search ends where a step gains less than a hundredth of a nat
    assert float(final(around).max()) < highest + 0.02
    assert final.rescaled(best) is None
    if not offset:  # which tells the read noise so well that every guess is far from it
        assert highest - float(posterior(_start(posterior))[0]) < 5
    gain, offset_found, read_noise = (float(each[0]) for each in final.parameters(best))
    assert gain == pytest.approx(2.0, rel=0.04)
    assert offset_found == pytest.approx(300.0 if name == "dim" else 100.0, abs=2.5)
    assert read_noise == pytest.approx(2.0 if make is not residuals and name != "lit" else 1.5, rel=0.15)
    # wherever the search begins: guesses and first steps decide how long it takes, not where it ends
    for factor, shift, start in ((1.05, 0.5, 1.7), (0.75, -20.0, 4.0), (1.5, 10.0, 0.7), (0.5, -5.0, 3.0)):
        again, same, _ = maximum_likelihood(posterior, start=(factor * gain, offset_found + shift, start))
        assert float(again(same)[0]) == pytest.approx(highest, abs=1e-3)


@pytest.mark.parametrize(("factor", "change"), [(1.03, 0.0), (1.0, 3.0)])
def test_signals_of_a_wrong_scale_are_brought_to_the_likely_one(factor, change):
    (true,) = dim_pair()
    posterior = LogPosterior([true.rescaled({0: (factor, change)})])
    middle = float(np.median(true.signal))
    final, best, _ = maximum_likelihood(posterior)
    assert final is not posterior
    assert final.rescaled(best) is None
    assert final.offset is None
    assert float(np.median(final.levels[0].signal)) == pytest.approx(middle, rel=4e-3)
    assert posterior.rescaled(posterior.coordinates(2.0, 100.0, 2.0)) is not None


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_an_offset_above_dim_levels_makes_no_probabilities_above_one(share):
    """Their signals' spread, taken to second order about no electrons, once did: bursts of two frames were refused or failed."""
    electrons = np.random.default_rng(2).gamma(4.0, 40.0, 20_000)
    one = collect_levels([readings(np.random.default_rng(3), electrons, share=share, step=1.0)])
    masses = LevelMasses(one).masses(np.full(3, 2.0), one.signal[[2, 4, 12]], np.full(3, 0.15))
    assert masses.max() < 1.0
    np.testing.assert_allclose(masses.sum(axis=2), 1.0, atol=1e-9)


def test_a_proposal_that_overflows_is_impossible_and_raises_no_warning(levels):
    posterior = LogPosterior(levels)
    with np.errstate(all="raise"):
        assert np.isneginf(posterior(np.array([[-10.86, 710.0, 2.9], [-10.86, 900.0, 2.9]]))).all()


def test_read_noise_that_a_wide_step_hides_is_not_possible():
    """Below a tenth of the step of pixel values, nothing tells read noises apart."""
    electrons = np.random.default_rng(2).gamma(2.0, 20.0, 20_000)
    posterior = LogPosterior([collect_levels([readings(np.random.default_rng(3), electrons, step=4.0)])], (99.0, 0.7))
    assert posterior.step == 4
    sets = np.array([[2.0, 99.0, 0.19], [2.0, 99.0, 0.21]])
    assert np.isneginf(posterior(posterior.coordinates(*sets.T))).tolist() == [True, False]


@pytest.mark.parametrize("edge", [-0.1, 0.0, 0.2])
def test_the_maximum_at_an_edge_of_the_prior_has_the_width_of_the_posterior_there(edge):
    def density(points):
        points = np.atleast_2d(points)
        value = -0.5 * ((points / (0.02, 0.1, 0.3)) ** 2).sum(1)
        return np.where(points[:, 2] < edge, -np.inf, value)

    best, steps = _climb(density, np.array([0.1, 0.2, edge + 0.7]), np.diag([0.03, 0.03, 0.2]))
    assert best == pytest.approx([0, 0, max(edge, 0)], abs=2e-3)
    deviations = np.sqrt(np.diag(steps.T @ steps)) / SHARE_OF_DEVIATION
    assert (np.abs(np.log(deviations[:2] / (0.02, 0.1))) < np.log(3)).all()


def test_the_interval_of_an_offset_reaches_the_darkest_signal_at_which_its_density_ends(levels):
    """That is the true offset where the background is black."""
    normal = np.random.default_rng(4).standard_normal((20, 2000))
    for offsets, dark, low, high in ((normal, 9.0, -NINETY, NINETY), (-np.abs(normal), -0.01, -1.96, 0.0)):
        ends = [replace(one, darkest=np.full_like(one.darkest, dark)) for one in levels]
        samples = [np.column_stack([np.full(2000, 2.0), one, np.full(2000, 3.0)]) for one in offsets]
        found = [DetectorPosterior(one, one[0], 1.0, 1.0, 2000, tuple(ends)).offset for one in samples]
        assert np.mean([one.q05 for one in found]) == pytest.approx(low, abs=0.05)
        assert np.mean([one.q95 for one in found]) == pytest.approx(high, abs=0.02)
