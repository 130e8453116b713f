"""The example of a denoiser trained with the likelihood: where values are clipped it beats squared differences."""

from __future__ import annotations

from types import ModuleType

import pytest


@pytest.mark.slow
def test_likelihood_beats_squared_differences_on_clipped_values(example: ModuleType) -> None:
    found = example.compare(num_steps=100, seed=1)
    assert found["squared differences"] > found["noisy"] + 3
    assert found["likelihood, true noise model"] > found["squared differences"] + 0.2
    assert found["likelihood, noise model learnt along"] > found["squared differences"] + 0.2
