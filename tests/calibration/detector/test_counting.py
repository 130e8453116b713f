"""A counting detector with dead time is recognised among the noise models."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.detector.models import Pixels, _simple, fit_models, simplest_sufficient

from ..simulators import counted_with_dead_time


def test_calibration_chooses_the_counter_for_a_counting_detector():
    generator = np.random.default_rng(2)
    rate = generator.uniform(2.0, 60.0, 12_000)
    counts, signal = counted_with_dead_time(generator, rate, dead_time=0.01), rate / (1 + 0.01 * rate)
    block = np.arange(len(rate)) // 64
    pixels = Pixels(signal, counts, block % 2 == 0, block)
    assert "counting" in _simple(pixels)
    assert "counting" not in _simple(replace(pixels, observation=signal + 2 * (counts - signal)))
    scores = fit_models(pixels, kinds=("poisson", "counting", "signal-gaussian"))
    chosen = simplest_sufficient(scores)
    assert chosen.name == "counting"
    assert float(chosen.model.dead_time) == pytest.approx(0.01, rel=0.15)
