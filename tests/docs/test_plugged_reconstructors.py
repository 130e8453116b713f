"""The examples of reconstructors that users write: from a cold start, learnt noise beats least squares where it has outliers."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch
from torch import nn

import noiseflow


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


def test_a_weight_needs_a_penalty() -> None:
    signal = torch.linspace(0, 1, 100)
    with pytest.raises(ValueError, match="penalty"):
        noiseflow.fit(noiseflow.Gaussian(), signal, signal + 0.1, weights="held-out")
    with pytest.raises(ValueError, match="tensor"):
        noiseflow.fit(noiseflow.Gaussian(), signal, signal + 0.1, weights="held out")
