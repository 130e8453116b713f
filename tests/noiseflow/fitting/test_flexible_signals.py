"""Joint fits of signals with as many parameters as pixels: noise is not learnt from residuals that the signal has taken away."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

import noiseflow
from noiseflow.fitting.weight import WeightedPenalty


class TotalVariation(nn.Module):
    """One noisy image, denoised: a free value at every pixel."""

    def __init__(self, size: int, scale: float) -> None:
        super().__init__()
        self.scale, self.raw = scale, nn.Parameter(torch.zeros(size, size))

    def image(self) -> Tensor:
        return self.scale * functional.softplus(self.raw)

    def signal(self) -> Tensor:
        return self.image().reshape(-1)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.signal()[pixels]

    def penalty(self) -> Tensor:
        image = self.image() / self.scale
        return 0.3 * (image.diff(dim=0).abs().mean() + image.diff(dim=1).abs().mean())

    def parameter_groups(self) -> list[dict[str, object]]:
        return [{"params": [self.raw], "lr": 0.1}]


def scene(size: int) -> Tensor:
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    return 6.0 + 10 * ((x > 0.1) & (y < 0.4)) + 24 * ((x + 0.3) ** 2 + (y - 0.2) ** 2 < 0.1)


def denoised(noise_model: nn.Module, observation: Tensor, clean: Tensor, **options: object) -> float:
    """PSNR (dB) of the image after a joint fit."""
    model = TotalVariation(len(clean), 20.0)
    noiseflow.fit(noise_model, model, observation, generator=torch.Generator().manual_seed(1), **options)
    error = (model.image().detach() - clean).square().mean()
    return float(10 * torch.log10((clean.max() - clean.min()) ** 2 / error))


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise_model",
    [noiseflow.SignalDependentGaussian(), noiseflow.Mixture(4, shared_shape=True, mean_preserving=True)],
    ids=["widths", "mixture"],
)
def test_one_image_is_denoised_as_under_the_true_noise(noise_model: nn.Module) -> None:
    """Under the true noise it has 25 dB; with noise learnt from what the image leaves of its own pixels, 17 and 13."""
    clean = scene(64)
    true = noiseflow.PoissonGaussian(gain=1.0, offset=0.0, read_noise=1.5)
    observation = true(clean).sample(generator=torch.Generator().manual_seed(0))
    assert denoised(noise_model, observation, clean, weights="held-out") > 24


def test_the_chosen_fit_is_that_of_a_new_model_at_the_chosen_weight() -> None:
    """A fit of counts freezes the noise model, and an earlier trial's must not stay frozen."""
    clean = scene(32)
    observation = torch.poisson(clean, generator=torch.Generator().manual_seed(0))
    found = []
    for weight in ("held-out", None):
        model: nn.Module = TotalVariation(len(clean), 20.0)
        model = model if weight else WeightedPenalty(model, found[0].weight_choice.weight)
        generator = torch.Generator().manual_seed(1)
        found += [
            noiseflow.fit(noiseflow.Poisson(), model, observation, weights=weight, num_steps=60, generator=generator)
        ]
    assert found[0].history == found[1].history
