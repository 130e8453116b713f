"""When a fit by turns goes on, with fits that do nothing but tell how good they are."""

from types import SimpleNamespace

import pytest
import torch

from noiseflow import Digitised, FitResult, Gaussian, Mixture, PoissonGaussian, SignalDependentGaussian
from recon.fields.occupancy import Occupancy
from recon.joint.alternation import Alternation
from recon.projection.image_formation import Linear, Transmission


@pytest.mark.parametrize(("signal_nll", "turns"), [([1.0, 1.0], 2), ([1.0, 0.99], 2), ([1.0, 0.5, 0.5], 3)])
def test_turns_go_on_while_they_gain(signal_nll: list[float], turns: int) -> None:
    rates, steps, released = [], [], []
    signals = iter(signal_nll)

    def run_fit(noise_model, signal, observation, **options):
        if signal is not signal_model:
            return FitResult(noise_model)
        assert not any(parameter.requires_grad for parameter in noise_model.parameters())
        rates.append(signal_model.learning_rate)
        steps.append(options["num_steps"])
        return FitResult(noise_model, held_out_nll=next(signals), num_steps=options["num_steps"])

    signal_model = SimpleNamespace(
        image_formation=None,
        occupancy=None,
        learning_rate=1.0,
        response_rate=0.04,
        signal=lambda: torch.zeros(5 * 8 * 8),
        release=lambda: released.append(0),
    )
    task = Alternation(signal_model, torch.zeros(5, 8, 8), None, 0, run_fit)
    task.alternate(Gaussian(), num_steps=112, rate=0.5)
    assert rates == [0.5, 0.25, 0.125][:turns]
    assert steps == [80, 32, 32][:turns]
    assert len(released) == 2 * turns - 1  # after every fit, of the noise model too
    assert signal_model.learning_rate == 1.0


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_steps_are_calmer_the_less_noise_there_is(noise: float) -> None:
    """Noise of a tenth of the contrast halves the steps; least squares for its own sake keeps them."""
    signal = torch.randn(5 * 64 * 64, generator=torch.Generator().manual_seed(0))
    observation = (signal + noise * torch.randn(signal.shape, generator=torch.Generator().manual_seed(1))).view(
        5, 64, 64
    )
    rates, offset = [], Linear()

    def run_fit(noise_model, signal, observation, **options):
        if signal is signal_model:
            rates.append((signal_model.learning_rate, offset.scaled_offset.requires_grad))
        return FitResult(noise_model, history={0: 1.0, 1: 1.0}, held_out_nll=1.0, num_steps=options["num_steps"])

    signal_model = SimpleNamespace(
        learning_rate=1.0,
        response_rate=0.04,
        signal=lambda: signal,
        image_formation=offset,
        occupancy=None,
        release=lambda: None,
    )
    task = Alternation(signal_model, observation, None, 0, run_fit, coarse_to_fine=False)
    assert task.settle(Gaussian(), final=True) == (noise < 0.2)
    task.fit_signal(Gaussian(), rate=1.0, num_steps=1)
    assert rates == [(1.0, True), (0.5, True), (1.0, True)]
    rates.clear()
    task.settle(Gaussian(), final=False, thoroughly=True)
    task.fit_signal(Gaussian(), rate=1.0, num_steps=1)
    assert rates[:-1] == [(0.5**stage, False) for stage in range(4)]
    assert rates[-1] == (pytest.approx(min(1.0, noise / 0.2), rel=0.05), True)


def test_peaks_of_single_electrons_that_no_table_resolves_are_told() -> None:
    """A gain of 100 and hardly any read noise: a peak for every electron among thousands of levels."""
    generator = torch.Generator().manual_seed(0)
    signal = 20_000 * torch.rand(9, 64, 64, generator=generator)
    observation = (signal + 10 * signal.sqrt() * torch.randn(signal.shape, generator=generator)).round()
    task = Alternation(SimpleNamespace(signal=lambda: signal), observation, None, 0, None)
    assert not task.can_tabulate(Digitised(PoissonGaussian(gain=100.0, offset=0.0, read_noise=0.1), step=1.0))
    assert task.can_tabulate(Digitised(PoissonGaussian(gain=100.0, offset=0.0, read_noise=0.5), step=1.0))


@pytest.mark.parametrize(("noise_model", "anew"), [(SignalDependentGaussian(), True), (Mixture(), False)])
def test_a_width_at_every_signal_is_read_off_anew(noise_model: torch.nn.Module, anew: bool) -> None:
    """Refined on a better signal, a Gaussian forgets the width that it had about a worse one; richer noise goes on."""
    seen = []

    def run_fit(noise_model, signal, observation, **options):
        seen.append(options["standardise"])
        return FitResult(noise_model)

    model = SimpleNamespace(signal=lambda: torch.zeros(5, 8, 8), release=lambda: None)
    Alternation(model, torch.zeros(5, 8, 8), None, 0, run_fit).refine(noise_model)
    assert seen == [anew]


@pytest.mark.parametrize(
    ("rate", "formation", "vacuum", "hasty"),
    [(1.0, "linear", False, 4), (1.0, "linear", True, 1), (0.5, "linear", False, 1), (1.0, "other", False, 1)],
)
def test_an_offset_that_no_vacuum_shows_learns_faster_from_a_rough_start(
    rate: float, formation: str, vacuum: bool, hasty: float
) -> None:
    seen = []

    def run_fit(noise_model, signal, observation, **options):
        seen.append(signal.response_rate)
        return FitResult(noise_model)

    response = Linear() if formation == "linear" else Transmission()
    occupancy = Occupancy(torch.ones(1, 1, 1), (4, 4, 4)) if vacuum else None
    model = SimpleNamespace(
        image_formation=response, occupancy=occupancy, learning_rate=1.0, response_rate=0.04, release=lambda: None
    )
    Alternation(model, torch.zeros(5, 8, 8), None, 0, run_fit).fit_signal(Gaussian(), rate=rate, num_steps=1)
    assert seen == [pytest.approx(0.04 * hasty)]
    assert model.response_rate == 0.04
