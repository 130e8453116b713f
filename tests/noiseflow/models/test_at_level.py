"""A noise model at a level says of raised values what the model inside says of the values."""

from __future__ import annotations

import pytest
import torch

import noiseflow
from noiseflow.models.at_level import at_level

SIGNALS = torch.linspace(2.0, 9.0, 8, dtype=torch.float64)
LEVEL = 1e5


def test_raised_values_are_as_likely_as_the_values() -> None:
    inside = noiseflow.PoissonGaussian().double()
    for model in (inside, noiseflow.Digitised(inside, 1.0, 0.0, 12.0)):
        raised = at_level(model, LEVEL)
        wanted, found = model(SIGNALS), raised(SIGNALS + LEVEL)
        observation = SIGNALS.round()
        torch.testing.assert_close(found.log_prob(observation + LEVEL), wanted.log_prob(observation))
        torch.testing.assert_close(found.mean - LEVEL, wanted.mean, atol=1e-8, rtol=0)
        torch.testing.assert_close(found.variance, wanted.variance, atol=1e-8, rtol=1e-6)


def test_a_level_is_kept_in_the_file(tmp_path) -> None:
    model = at_level(noiseflow.Digitised(noiseflow.Gaussian(0.5), 1.0, 0.0, 12.0), LEVEL)
    loaded = noiseflow.load(noiseflow.save(model, tmp_path / "model.safetensors"))
    assert (loaded.low, loaded.high, loaded.model.level) == (LEVEL, LEVEL + 12, LEVEL)


def test_rounding_and_images_stay_outside() -> None:
    with pytest.raises(ValueError, match="innermost model"):
        noiseflow.AtLevel(noiseflow.Digitised(noiseflow.Gaussian(), 1.0), LEVEL)
