"""When a fit by turns goes on, with fits that do nothing but tell how good they are."""

from types import SimpleNamespace

import pytest
import torch

from noiseflow import Digitised, FitResult, Gaussian, PoissonGaussian
from recon.alternation import Alternation


@pytest.mark.parametrize(("signal_nll", "turns"), [([1.0, 1.0], 2), ([1.0, 0.99], 2), ([1.0, 0.5, 0.5], 3)])
def test_turns_go_on_while_they_gain(signal_nll: list[float], turns: int) -> None:
    rates, steps = [], []
    signals = iter(signal_nll)

    def run_fit(noise_model, signal, observation, **options):
        if signal is not signal_model:
            return FitResult(noise_model)
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


def test_peaks_of_single_electrons_that_no_table_resolves_are_told() -> None:
    """A gain of 100 and hardly any read noise: a peak for every electron among thousands of levels."""
    generator = torch.Generator().manual_seed(0)
    signal = 20_000 * torch.rand(9, 64, 64, generator=generator)
    observation = (signal + 10 * signal.sqrt() * torch.randn(signal.shape, generator=generator)).round()
    task = Alternation(SimpleNamespace(signal=lambda: signal), observation, None, 0, None)
    assert not task.can_tabulate(Digitised(PoissonGaussian(gain=100.0, offset=0.0, read_noise=0.1), step=1.0))
    assert task.can_tabulate(Digitised(PoissonGaussian(gain=100.0, offset=0.0, read_noise=0.5), step=1.0))
