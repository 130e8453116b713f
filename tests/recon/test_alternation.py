"""When a fit by turns goes on, with fits that do nothing but tell a history."""

from types import SimpleNamespace

import pytest
import torch

from noiseflow import FitResult, Gaussian
from recon.alternation import Alternation

FALLING = {8 * look: 1.1 - 0.01 * look for look in range(11)}
RISING = {8 * look: 1.0 + 0.01 * look for look in range(11)}


@pytest.mark.parametrize(("history", "turns"), [(FALLING, 1), (RISING, 2), ({0: 1.0, 4: 1.05, 8: 1.1}, 1)])
def test_a_turn_that_was_best_early_is_followed_by_another(history: dict[int, float], turns: int) -> None:
    rates = []

    def run_fit(noise_model, signal, observation, **options):
        if signal is signal_model:
            rates.append(signal_model.learning_rate)
        return FitResult(noise_model, held_out_nll=1.0, num_steps=options["num_steps"], history=history)

    signal_model = SimpleNamespace(learning_rate=1.0, signal=lambda: torch.zeros(5 * 8 * 8))
    task = Alternation(signal_model, torch.zeros(5, 8, 8), None, 0, run_fit)
    task.alternate(Gaussian(), num_steps=80, rate=0.5)
    assert rates == [0.5, 0.25][:turns]
    assert signal_model.learning_rate == 1.0
