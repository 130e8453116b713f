"""When a fit by turns goes on, with fits that do nothing but tell how good they are."""

from types import SimpleNamespace

import pytest
import torch

from noiseflow import FitResult, Gaussian
from recon.alternation import Alternation


@pytest.mark.parametrize(
    ("signal_nll", "noise_nll", "turns"),
    [([1.0, 1.0], [1.0], 2), ([1.0, 0.5, 0.5], [1.0, 0.4], 3), ([1.0, 0.5], [1.0, 0.5], 2)],
)
def test_turns_go_on_while_both_gain(signal_nll: list[float], noise_nll: list[float], turns: int) -> None:
    rates, steps = [], []
    signals, noises = iter(signal_nll), iter(noise_nll)

    def run_fit(noise_model, signal, observation, **options):
        if signal is not signal_model:
            return FitResult(noise_model, held_out_nll=next(noises))
        assert not any(parameter.requires_grad for parameter in noise_model.parameters())
        rates.append(signal_model.learning_rate)
        steps.append(options["num_steps"])
        return FitResult(noise_model, held_out_nll=next(signals), num_steps=options["num_steps"])

    signal_model = SimpleNamespace(learning_rate=1.0, signal=lambda: torch.zeros(5 * 8 * 8))
    task = Alternation(signal_model, torch.zeros(5, 8, 8), None, 0, run_fit)
    task.alternate(Gaussian(), num_steps=112, rate=0.5)
    assert rates == [0.5, 0.25, 0.125][:turns]
    assert steps == [80, 32, 32][:turns]
    assert signal_model.learning_rate == 1.0
