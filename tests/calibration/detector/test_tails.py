"""Tails that no divergence of histograms sees are reported, and a model that has them is chosen."""

import numpy as np
import pytest

import noiseflow
from calibration.detector.models import (
    Pixels,
    collect_pixels,
    fit_models,
    foremost,
    heavy_tailed,
    simplest_sufficient,
)
from calibration.exposures.frames import ExposurePair
from calibration.registration.aligned import align_pair

from ..simulators import exposed, random_scene


def pixels(generator, number, *, telegraph):
    """Pixel values of which 5 % jump by 12 e⁻ (random telegraph noise), if `telegraph`."""
    electrons = generator.uniform(20, 60, number)
    jumps = 12 * generator.integers(-1, 2, number) * (generator.random(number) < 0.05) if telegraph else 0
    counts = 100 + 2 * (generator.poisson(electrons) + 1.5 * generator.standard_normal(number) + 2 * jumps)
    block = np.arange(number) // 64
    return Pixels(100 + 2 * electrons, np.round(counts), block % 2 == 1, block, 100 + 2 * electrons)


@pytest.mark.parametrize("telegraph", [True, False])
def test_heavy_tails_are_seen_and_modelled(telegraph):
    found = pixels(np.random.default_rng(0), 40_000, telegraph=telegraph)
    scores = fit_models(found, detector=(2.0, 100.0, 1.5))
    shot = next(score for score in scores if score.name == "poisson-gaussian")
    assert heavy_tailed(shot.model, found) == telegraph
    chosen = simplest_sufficient(scores)
    assert (chosen.name == "poisson-gaussian") == (not telegraph)
    assert chosen in foremost(scores)
    assert not heavy_tailed(chosen.model, found)


def test_a_detector_that_noise_does_not_fit_is_searched_for_once(monkeypatch):
    found, searched = pixels(np.random.default_rng(0), 20_000, telegraph=True), []
    search = noiseflow.PoissonGaussian.standardise
    monkeypatch.setattr(
        noiseflow.PoissonGaussian, "standardise", lambda *given, **kept: searched.append(search(*given, **kept))
    )
    scores = {score.name: score for score in fit_models(found)}
    assert "mixture" in scores  # the second round, whose Poisson-Gaussian is the first's
    assert len(searched) == 1
    (alone,) = fit_models(found, kinds=["poisson-gaussian"])
    assert scores["poisson-gaussian"].nll <= alone.nll + 1e-6


def test_correcting_for_the_noise_of_the_signal_leaves_the_histogram_of_a_clean_pair_smooth():
    generator = np.random.default_rng(0)
    scene = random_scene(generator)
    pair = align_pair(ExposurePair(exposed(generator, scene), exposed(generator, 16 * scene)))
    (score,) = fit_models(collect_pixels([pair]), kinds=["poisson-gaussian"])
    overall = score.evaluation.overall
    assert overall.jsd < 1.5 * overall.jsd_floor
