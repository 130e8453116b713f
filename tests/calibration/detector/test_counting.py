"""A counting detector with dead time is recognised among the noise models."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from calibration.detector.models import Pixels, _counting, fit_models, simplest_sufficient
from noiseflow.commands.sampling import stored

from ..simulators import counted_with_dead_time


@pytest.mark.slow
def test_calibration_chooses_the_counter_for_a_counting_detector():
    generator = np.random.default_rng(2)
    rate = generator.uniform(2.0, 60.0, 12_000)
    counts, signal = counted_with_dead_time(generator, rate, dead_time=0.01), rate / (1 + 0.01 * rate)
    block = np.arange(len(rate)) // 64
    pixels = Pixels(signal, counts, block % 2 == 0, block, signal)
    assert _counting(pixels)
    assert not _counting(replace(pixels, observation=signal + 2 * (counts - signal)))
    scores = fit_models(pixels, kinds=("poisson", "counting", "signal-gaussian"))
    chosen = simplest_sufficient(scores)
    assert chosen.name == "counting"
    assert float(chosen.model.dead_time) == pytest.approx(0.01, rel=0.15)


def eight_bit(number: int = 16_000) -> Pixels:
    """8-bit values at 0.2 counts per electron: whole numbers that scatter less than counts, of no counter."""
    generator = np.random.default_rng(5)
    electrons = generator.uniform(100, 900, number)
    signal = 20 + 0.2 * electrons
    counts = np.round(20 + 0.2 * (generator.poisson(electrons) + 2 * generator.standard_normal(number))).clip(0, 255)
    block = np.arange(number) // 64
    return Pixels(signal, counts, block % 2 == 0, block, signal)


def test_no_counter_is_tried_on_values_that_do_not_scatter_as_its_counts():
    assert not _counting(eight_bit())


def test_shot_noise_finer_than_the_codes_is_rounded_to_them_and_needs_no_flexible_models():
    scores = fit_models(eight_bit(), detector=(0.2, 20.0, 2.0))
    assert [score.name for score in scores] == ["gaussian", "poisson", "poisson-gaussian"]
    shot = next(score for score in scores if score.name == "poisson")
    drawn = shot.model(torch.full((1000,), 100.0)).sample()
    assert torch.equal(drawn, drawn.round())
    assert shot.evaluation.overall.jsd < 3 * shot.evaluation.overall.jsd_floor


@pytest.mark.parametrize(("gain", "read_noise"), [(2.0, 0.0), (2.0, 0.3), (1.0, 0.0)])
def test_shot_noise_of_a_count_or_more_per_electron_is_rounded_to_the_codes(gain: float, read_noise: float):
    generator = np.random.default_rng(3)
    electrons, blocks = np.exp(generator.normal(4.0, 0.6, 16_000)), np.arange(16_000) // 64
    counts = generator.poisson(electrons) + read_noise * generator.standard_normal(electrons.size)
    pixels = Pixels(100 + gain * electrons, np.round(100 + gain * counts), blocks % 2 == 0, blocks, electrons)
    (shot,) = fit_models(pixels, kinds="poisson")
    drawn = shot.model(torch.full((1000,), 221.3)).sample(generator=torch.Generator().manual_seed(0))
    assert torch.equal(drawn, drawn.round())
    assert stored(drawn.numpy(), "auto", np.dtype(np.float32), shot.model).dtype == np.uint16
    codes = shot.model(torch.tensor([221.3])).log_prob(torch.arange(0.0, 500.0, float(shot.model.step))[:, None])
    assert float(codes.exp().sum()) == pytest.approx(1.0, abs=1e-4)
    assert np.isfinite(shot.nll)
