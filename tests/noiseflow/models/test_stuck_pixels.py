"""Dead and hot pixels are found, and the other pixels keep their law."""

from __future__ import annotations

import math

import pytest
import torch

import noiseflow
from benchmarks.divergences import kl_divergence
from noiseflow.models.stuck_pixels import stuck_at

ROUNDED = noiseflow.Digitisation(step=1.0)


def counts(rate: float = 20.0, count: int = 40_000) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    signal = 1 + rate * torch.rand(count, generator=generator)
    return signal, torch.poisson(signal, generator=generator)


def stuck(observation: torch.Tensor, level: float, share: float) -> torch.Tensor:
    chosen = torch.rand(observation.shape, generator=torch.Generator().manual_seed(int(level))) < share
    return observation.masked_fill(chosen, level)


def test_dead_and_hot_pixels_are_found_and_the_detector_behind_them() -> None:
    signal, observation = counts()
    given = stuck(stuck(observation, 0.0, 0.1), 255.0, 0.02)
    model = noiseflow.fit(noiseflow.PoissonGaussian(), signal, given).noise_model
    assert isinstance(model, noiseflow.StuckPixels)
    assert isinstance(model.model, noiseflow.StuckPixels)
    shares = {each.level: torch.tensor(each.share).mean().item() for each in (model, model.model)}
    assert shares == {
        255.0: pytest.approx(0.02, abs=0.003),
        0.0: pytest.approx(0.098, abs=0.006),
    }
    truth = noiseflow.StuckPixels(noiseflow.StuckPixels(noiseflow.Poisson(), 0.0, 0.1), 255.0, 0.02)
    assert kl_divergence(truth, model, signal)[0] < 0.0005
    found = noiseflow.select(signal, given).chosen
    assert found.name == "PoissonGaussian"
    assert isinstance(found.model, noiseflow.StuckPixels)


def test_counts_and_clipped_values_have_no_stuck_pixels() -> None:
    signal, observation = counts()
    assert stuck_at(signal, observation, ROUNDED) == []
    assert stuck_at(signal, observation.clamp(max=15), ROUNDED) == []
    assert stuck_at(signal, 8 * observation, noiseflow.Digitisation(8.0)) == []
    assert stuck_at(10 * signal, (10 * observation + 2 * torch.randn(observation.shape)).round(), ROUNDED) == []


@pytest.mark.parametrize("dark", [0.01, 0.05])
def test_vacuum_with_few_dark_counts_has_no_stuck_pixels(dark: float) -> None:
    signal = torch.cat(
        [torch.full((25_000,), dark), torch.linspace(10, 40, 25_000)]
    )  # half of the groups by signal are vacuum
    observation = torch.poisson(signal, generator=torch.Generator().manual_seed(0))
    assert stuck_at(signal, observation, ROUNDED) == []


def test_a_model_with_stuck_pixels_is_saved_and_has_their_moments(tmp_path) -> None:
    model = noiseflow.StuckPixels(noiseflow.Poisson(), level=0.0, share=0.25)
    noiseflow.save(model, tmp_path / "model.safetensors")
    signal = torch.full((100_000,), 8.0)
    loaded = noiseflow.load(tmp_path / "model.safetensors")(signal)
    drawn = loaded.sample(generator=torch.Generator().manual_seed(0))
    assert loaded.mean[0].item() == pytest.approx(6)
    assert drawn.mean().item() == pytest.approx(6, abs=0.05)
    assert drawn.var().item() == pytest.approx(loaded.variance[0].item(), rel=0.02)
    assert (drawn == 0).double().mean().item() == pytest.approx(
        loaded.log_prob(torch.tensor(0.0))[0].exp().item(), abs=5e-3
    )
    with pytest.raises(ValueError, match="needs images"):
        noiseflow.StuckPixels(noiseflow.RadialFlow(neighbourhood=3))


def energies(count: int = 20_000, scale: float = 0.25) -> tuple[torch.Tensor, torch.Tensor]:
    """A Poisson number of exponential energies, 0 without any."""
    generator = torch.Generator().manual_seed(0)
    signal = 0.2 + 1.8 * torch.rand(count, generator=generator)
    number = torch.poisson(signal / scale, generator=generator)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return signal, scale * torch._standard_gamma(number.clamp(min=1)) * (number > 0)


def test_zeros_beside_a_density_have_their_share_at_each_signal(tmp_path) -> None:
    signal, observation = energies()
    assert not noiseflow.detect_digitisation(observation, signal).found
    fitted = noiseflow.fit(noiseflow.Mixture(4), signal, observation, num_steps=40).noise_model
    chosen = noiseflow.select(signal, observation, candidates={"": noiseflow.Mixture(4)}, num_steps=40).chosen.model
    noiseflow.save(fitted, tmp_path / "model.safetensors")
    at = torch.tensor([0.3, 0.6, 1.0, 1.5])
    for model in (fitted, chosen, noiseflow.load(tmp_path / "model.safetensors")):
        assert isinstance(model, noiseflow.StuckPixels)
        law = model(at)
        assert law.log_prob(torch.tensor(0.0)).exp().tolist() == pytest.approx((-at / 0.25).exp().tolist(), abs=0.01)
        assert (law.cdf(torch.tensor(0.0)) - law.cdf_below(torch.tensor(0.0))).tolist() == pytest.approx(
            (-at / 0.25).exp().tolist(), abs=0.01
        )
        assert law.mean.tolist() == pytest.approx(at.tolist(), rel=0.05)


def test_a_value_that_repeats_in_the_middle_is_found_and_rounding_by_the_number_format_is_none() -> None:
    generator = torch.Generator().manual_seed(3)
    signal = torch.rand(20_000, generator=generator)
    observation = signal + 0.1 * torch.randn(signal.shape, generator=generator)
    assert stuck_at(signal, observation, noiseflow.Digitisation()) == []
    assert stuck_at(signal, (observation + 1000) - 1000, noiseflow.Digitisation()) == []
    ((level, share),) = stuck_at(signal, stuck(observation, 0.5, 0.02), noiseflow.Digitisation())
    assert level == 0.5
    assert share == pytest.approx([0.02] * len(share), abs=0.008)


def test_flags_whose_share_depends_on_the_signal_are_no_clipping_limit() -> None:
    signal, observation = counts()
    flagged = torch.rand(signal.shape, generator=torch.Generator().manual_seed(2)) < signal / 100
    given = observation.masked_fill(flagged, 4095.0)
    assert noiseflow.detect_digitisation(given, signal).high == math.inf
    ((level, share),) = stuck_at(signal, given, ROUNDED)
    assert level == 4095
    assert [share[0], share[-1]] == pytest.approx([0.01, 0.21], abs=0.015)
    model = noiseflow.fit(noiseflow.Mixture(4), signal, given, num_steps=60).noise_model
    truth = noiseflow.StuckPixels(noiseflow.Poisson(), 4095.0, (0.01, 0.21), (1, 21))
    assert kl_divergence(truth, model, signal)[0] < 0.003
