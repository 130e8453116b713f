"""Importance sampling: densities of known mass, smooth and with narrow peaks."""

import numpy as np
import pytest

from calibration.detector.importance import importance_sample


def rugged(draws):
    """A normal density, and in place of the part beyond one deviation of its third coordinate a field of narrow peaks."""
    peaks = np.cos(2 * np.pi * draws / 0.4).sum(axis=1) - 3
    return -0.5 * (draws**2).sum(axis=1) + np.where(draws[:, 2] < -1, 6 * peaks + 6, 0.0)


def sample(density, seed=0):
    return importance_sample(density, [(np.zeros(3), np.eye(3))], np.random.default_rng(seed))


def test_every_value_belongs_to_its_own_draw():
    shifted = sample(lambda draws: -0.5 * ((draws - [1.0, -0.5, 0.3]) ** 2 / [0.25, 1.0, 4.0]).sum(axis=1))
    mean = shifted.weight @ shifted.draws
    deviation = np.sqrt(shifted.weight @ (shifted.draws - mean) ** 2)
    assert mean == pytest.approx([1.0, -0.5, 0.3], abs=0.2)
    assert deviation == pytest.approx([0.5, 1.0, 2.0], rel=0.15)


def test_narrow_peaks_in_the_tail_are_measured():
    generator = np.random.default_rng(0)
    normal = generator.standard_normal((400_000, 3))
    ratio = np.exp(rugged(normal) + 0.5 * (normal**2).sum(axis=1))
    share = ratio[normal[:, 2] < -1].sum() / ratio.sum()
    found = sample(rugged)
    assert found is not None
    assert found.weight[found.draws[:, 2] < -1].sum() == pytest.approx(share, abs=0.15)


def test_a_narrow_peak_at_the_maximum_does_not_hide_the_broad_one_beside_it():
    """A peak three nats higher, a hundredth as wide each way, holds a fifty-thousandth of the mass."""

    def density(draws):
        peak = 3.0 - 0.5 * (((draws - [2.0, 0.0, 0.0]) / 0.01) ** 2).sum(axis=1)
        return np.logaddexp(-0.5 * (draws**2).sum(axis=1), peak)

    narrow, broad = (np.array([2.0, 0.0, 0.0]), 1e-4 * np.eye(3)), (np.zeros(3), np.eye(3))
    found = importance_sample(density, [narrow, broad], np.random.default_rng(0))
    assert found is not None
    mean = found.weight @ found.draws
    assert mean == pytest.approx([0.0, 0.0, 0.0], abs=0.15)
    assert np.sqrt(found.weight @ (found.draws - mean) ** 2) == pytest.approx([1.0, 1.0, 1.0], rel=0.15)
