"""Dead and hot pixels are found, and the other pixels keep their law."""

from __future__ import annotations

import pytest
import torch

import noiseflow
from benchmarks.divergences import kl_divergence
from noiseflow.models.stuck_pixels import stuck_at


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
    assert {model.level: model.share, model.model.level: model.model.share} == {
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
    assert stuck_at(signal, observation, 1.0) == []
    assert stuck_at(signal, observation.clamp(max=15), 1.0) == []
    assert stuck_at(signal, 8 * observation, 8.0) == []
    assert stuck_at(10 * signal, (10 * observation + 2 * torch.randn(observation.shape)).round(), 1.0) == []
    assert stuck_at(signal, stuck(signal, 0.0, 0.1), 0.0) == []


@pytest.mark.parametrize("dark", [0.01, 0.05])
def test_vacuum_with_few_dark_counts_has_no_stuck_pixels(dark: float) -> None:
    signal = torch.cat(
        [torch.full((25_000,), dark), torch.linspace(10, 40, 25_000)]
    )  # half of the groups by signal are vacuum
    observation = torch.poisson(signal, generator=torch.Generator().manual_seed(0))
    assert stuck_at(signal, observation, 1.0) == []


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
    with pytest.raises(ValueError, match="Digitised"):
        noiseflow.StuckPixels(noiseflow.Gaussian())
