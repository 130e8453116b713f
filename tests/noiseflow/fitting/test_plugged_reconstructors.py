"""Joint fits of a signal model that a user writes, from a cold start and without options: many outliers."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import noiseflow

SIZE, ANGLES = 24, 30


class Tomography(nn.Module):
    """A square image, rotated and summed along its columns, with total variation."""

    def __init__(self) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.zeros(SIZE, SIZE))
        theta = torch.arange(ANGLES) * math.pi / ANGLES
        turn = torch.stack([theta.cos(), -theta.sin(), 0 * theta, theta.sin(), theta.cos(), 0 * theta], 1)
        self.register_buffer(
            "places", nn.functional.affine_grid(turn.view(-1, 2, 3), [ANGLES, 1, SIZE, SIZE], align_corners=False)
        )

    def image(self) -> Tensor:
        return nn.functional.softplus(4 * self.raw)

    def signal(self) -> Tensor:
        whole = self.image().expand(ANGLES, 1, SIZE, SIZE)
        return nn.functional.grid_sample(whole, self.places, align_corners=False).sum(2).reshape(-1)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.signal()[pixels]

    def penalty(self) -> Tensor:
        image = self.image()
        down, right = image.diff(dim=0)[:, :-1], image.diff(dim=1)[:-1]
        return 0.02 * torch.sqrt(down**2 + right**2 + 1e-4).mean()

    def parameter_groups(self) -> list[dict[str, object]]:
        return [{"params": [self.raw], "lr": 0.05}]


def _psnr(image: Tensor, truth: Tensor) -> float:
    return float(10 * torch.log10(truth.max() ** 2 / (image - truth).square().mean()))


def test_tomography_with_outliers_is_more_accurate_than_least_squares() -> None:
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    truth = (x**2 + y**2 < 0.5).float() + ((x - 0.2) ** 2 + (y + 0.1) ** 2 < 0.06).float()
    model = Tomography()
    with torch.no_grad():
        model.raw.copy_(torch.log(torch.expm1(truth.clamp(min=1e-3))) / 4)
        clean = model.signal()
    noise = noiseflow.Gaussian(0.5)(clean).sample(generator=generator)
    hit = torch.rand(clean.shape, generator=generator) < 0.1
    observation = torch.where(hit, noise + 20 * torch.rand(clean.shape, generator=generator), noise)
    found, likelihood = {}, {}
    for name, kind in (("joint", noiseflow.Mixture(4)), ("least squares", noiseflow.Gaussian())):
        reconstructor = Tomography()
        noiseflow.fit(kind, reconstructor, observation, num_steps=150, generator=torch.Generator().manual_seed(1))
        found[name] = _psnr(reconstructor.image().detach(), truth)
        likelihood[name] = float(kind(clean).log_prob(observation).mean())
    assert found["joint"] > found["least squares"] + 3
    assert likelihood["joint"] > likelihood["least squares"] + 1


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("stopped", [5, 15])
def test_a_resumed_fit_ends_where_the_uninterrupted_one_does(stopped: int, frozen: bool) -> None:
    """Before and after the noise model has been learnt for the first time; the signal model of a caller may be at any state."""
    with torch.no_grad():
        observation = noiseflow.Gaussian(0.5)(Tomography().signal()).sample(generator=torch.Generator().manual_seed(0))
    states: list[dict] = []

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        model, noise = Tomography(), noiseflow.SignalDependentGaussian()
        if frozen:  # far too narrow, with outliers, for the first signal
            noise = noiseflow.Mixture(4)
            known = torch.full((2000,), 10.0)
            generator = torch.Generator().manual_seed(2)
            hit = torch.rand(2000, generator=generator) < 0.05
            known_noise = 0.1 * torch.randn(2000, generator=generator) + 50 * hit * torch.rand(
                2000, generator=generator
            )
            noiseflow.fit(noise, known, known + known_noise)
            noise.requires_grad_(False)
        generator = torch.Generator().manual_seed(1)
        noiseflow.fit(noise, model, observation, num_steps=20, checkpoint_interval=0, generator=generator, **options)
        return model.image().detach(), noise(torch.tensor([5.0, 20.0])).variance.detach()

    whole = run(checkpoint=states.append)
    for found, expected in zip(run(resume=states[stopped - 1]), whole, strict=True):
        assert torch.allclose(found, expected, rtol=1e-6, atol=1e-7)


def test_the_learning_rate_is_that_of_a_signal_model_without_its_own() -> None:
    class Level(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.level = nn.Parameter(torch.zeros(()))

        def forward(self, pixels: Tensor) -> Tensor:
            return self.level.expand(pixels.shape)

    model, observation = Level(), 5 + torch.randn(1000, generator=torch.Generator().manual_seed(0))
    noiseflow.fit(noiseflow.SignalDependentGaussian(), model, observation, num_steps=60, learning_rate=0.5)
    assert float(model.level.detach()) == pytest.approx(5, abs=0.3)
