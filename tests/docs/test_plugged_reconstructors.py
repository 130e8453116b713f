"""The examples of reconstructors that users write: from a cold start, learnt noise beats least squares where it has outliers."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch
from torch import nn

import noiseflow
from noiseflow.fitting.signal_models import WeightedPenalty


@pytest.mark.parametrize(
    ("name", "gain"),
    [
        ("deconvolution", 0.5),
        pytest.param("tomography", 2.0, marks=pytest.mark.slow),
        pytest.param("super-resolution", 3.0, marks=pytest.mark.slow),
    ],
)
def test_learnt_noise_against_least_squares(example: ModuleType, name: str, gain: float) -> None:
    make, instrument, truth, noise = example.SCENES[name]
    observation = example.measured(instrument(), truth, noise)
    found = {}
    for kind, noise_model in (("learnt", example.learnt()), ("least squares", noiseflow.Gaussian())):
        image, result = example.reconstruct(make, observation, noise_model, num_steps=200)
        found[kind] = example.psnr(image, truth), result.last_nll
    assert found["learnt"][0] > found["least squares"][0] + gain
    assert found["learnt"][1] < found["least squares"][1] - 1


def test_the_weight_of_the_penalty_is_chosen_by_held_out_pixels(example: ModuleType) -> None:
    make, instrument, truth, noise = example.SCENES["tomography"]
    observation, options = example.measured(instrument(), truth, noise), {"num_steps": 100, "weights": "held-out"}

    def made_badly() -> nn.Module:
        model = make()
        model.weight *= 20
        return model

    (image, result), (other, second) = (
        example.reconstruct(each, observation, noiseflow.Gaussian(), **options) for each in (make, made_badly)
    )
    assert result.weight_choice.weight > 4 * second.weight_choice.weight
    assert example.psnr(other, truth) == pytest.approx(example.psnr(image, truth), abs=1.5)


@pytest.mark.slow
def test_noise_is_not_learnt_from_residuals_that_the_image_has_taken_away(example: ModuleType) -> None:
    """One image with as many unknowns as pixels: 24.4 dB, or 21 to 22 where residuals are taken as they are."""
    make, instrument, truth, noise = example.SCENES["denoising"]
    observation = example.measured(instrument(), truth, noise, seed=1)
    image, _ = example.reconstruct(make, observation, example.learnt(), num_steps=300, weights="held-out")
    assert example.psnr(image, truth) > 23


@pytest.mark.parametrize("spelt", ["frozen", "not trained"])
def test_a_calibrated_noise_model_begins_as_simple_noise_where_errors_look_like_outliers(
    example: ModuleType, spelt: str
) -> None:
    """One image of a narrow noise with far outliers: its own density alone ends at 10 dB in place of 30."""
    truth, generator = example.discs(32, 32), torch.Generator().manual_seed(3)

    def noisy(signal: torch.Tensor) -> torch.Tensor:
        hit = torch.rand(signal.shape, generator=generator) < 0.05
        outliers = 10 * hit * torch.rand(signal.shape, generator=generator)
        return signal + 0.05 * torch.randn(signal.shape, generator=generator) + outliers

    signal = 3 * torch.rand(20_000, generator=generator)
    calibrated = noiseflow.fit(noiseflow.Mixture(4), signal, noisy(signal)).noise_model
    state = {name: value.clone() for name, value in calibrated.state_dict().items()}
    calibrated.requires_grad_(spelt != "frozen")
    model = WeightedPenalty(example.Denoising((32, 32), 1.0), 8.0)
    options = {"num_steps": 150, "train_noise": spelt == "frozen", "generator": generator}
    noiseflow.fit(calibrated, model, noisy(truth.reshape(-1)), **options)
    assert example.psnr(model.image().detach(), truth) > 25
    assert all(torch.equal(value, state[name]) for name, value in calibrated.state_dict().items())


def test_a_frozen_model_of_counts_is_the_likelihood_from_the_start(example: ModuleType) -> None:
    """Simple noise first would cost 6 dB."""
    truth = 2 * example.discs(32, 32)
    observation = torch.poisson(truth.reshape(-1), generator=torch.Generator().manual_seed(4))
    found = {}
    for name, options in (("cold", {}), ("as it is", {"standardise": False})):
        model = WeightedPenalty(example.Denoising((32, 32), 1.0), 2.0)
        noise_model = noiseflow.Poisson().requires_grad_(False)
        noiseflow.fit(noise_model, model, observation, num_steps=40, generator=torch.Generator(), **options)
        found[name] = model.image().detach()
    assert torch.equal(found["cold"], found["as it is"])


def test_the_chosen_fit_is_that_of_a_new_model_at_the_chosen_weight(example: ModuleType) -> None:
    """A fit of counts freezes the noise model, and an earlier trial's must not stay frozen."""
    observation = torch.poisson(6 + 10 * example.discs(32, 32), generator=torch.Generator().manual_seed(0))
    found: list[noiseflow.FitResult] = []
    for weights in ("held-out", None):
        model: nn.Module = example.Denoising((32, 32), 20.0)
        model = model if weights else WeightedPenalty(model, found[0].weight_choice.weight)
        options = {"weights": weights, "num_steps": 60, "generator": torch.Generator().manual_seed(1)}
        found.append(noiseflow.fit(noiseflow.Poisson(), model, observation, **options))
    assert found[0].history == found[1].history


def test_a_weight_needs_a_penalty() -> None:
    signal = torch.linspace(0, 1, 100)
    with pytest.raises(ValueError, match="penalty"):
        noiseflow.fit(noiseflow.Gaussian(), signal, signal + 0.1, weights="held-out")
    with pytest.raises(ValueError, match="tensor"):
        noiseflow.fit(noiseflow.Gaussian(), signal, signal + 0.1, weights="held out")
