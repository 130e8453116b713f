"""Models of the signal: a still scene corrected for the frames in its own mean, and contracts that are checked at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import noiseflow


def frames(count: int, *, outliers: float = 0.0, level: float = 300.0, width: float = 10.0) -> tuple[Tensor, Tensor]:
    """A clean image (64, 64) in counts, and exposures with Gaussian noise of which a share is eight times as wide."""
    generator = torch.Generator().manual_seed(0)
    clean = level + 700 * torch.rand(64, 64, generator=generator)
    far = torch.rand(count, 64, 64, generator=generator) < outliers
    noise = torch.randn(count, 64, 64, generator=generator) * torch.where(far, 8.0, 1.0)
    return clean, clean + width * noise


@pytest.mark.parametrize("count", [2, 3, 8])
def test_noise_of_a_static_scene_has_the_right_width(count: int) -> None:
    _, exposures = frames(count)
    model = noiseflow.Gaussian()
    noiseflow.fit(model, noiseflow.StaticScene(exposures), exposures, num_steps=100)
    assert float(model.log_scale.detach().exp()) == pytest.approx(10, rel=0.02)


def test_static_scene_beats_the_mean_where_noise_has_outliers() -> None:
    clean, exposures = frames(8, outliers=0.05)
    scene = noiseflow.StaticScene(exposures)
    noiseflow.fit(noiseflow.Mixture(mean_preserving=True), scene, exposures, num_steps=300)
    of_mean, of_fit = ((image - clean).square().mean().sqrt() for image in (exposures.mean(0), scene.image()))
    assert float(of_fit) < 0.75 * float(of_mean)


def test_a_known_signal_and_a_model_of_it_are_fitted_alike() -> None:
    clean, (exposure,) = frames(1)
    found = [
        noiseflow.fit(noiseflow.Gaussian(), given, exposure.round(), num_steps=20).held_out_nll
        for given in (clean, noiseflow.KnownSignal(clean))
    ]
    assert found[0] == found[1]


def test_static_scene_leaves_missing_pixels_out() -> None:
    clean, exposures = frames(4)
    exposures[0, :32] = math.nan
    scene = noiseflow.StaticScene(exposures)
    assert torch.equal(scene.image()[:32], exposures[1:, :32].mean(0))
    model = noiseflow.Gaussian()
    noiseflow.fit(model, scene, exposures, num_steps=60, skip_non_finite=True)
    assert float(model.log_scale.detach().exp()) == pytest.approx(10, rel=0.03)
    assert float((scene.image() - clean).abs().mean()) < 6


class Wrong(nn.Module):
    """A signal model whose shapes can be spoilt."""

    def __init__(self, *, flat: bool = True, scalar: bool = True, per_pixel: bool = True) -> None:
        super().__init__()
        self.level = nn.Parameter(torch.ones(6, 5))
        self.flat, self.scalar, self.per_pixel = flat, scalar, per_pixel

    def forward(self, pixels: Tensor) -> Tensor:
        found = self.level.reshape(-1)[pixels]
        return found if self.per_pixel else found[:, None]

    def signal(self) -> Tensor:
        return self.level.reshape(-1) if self.flat else self.level

    def penalty(self) -> Tensor:
        return self.level.sum() if self.scalar else self.level.sum(0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"flat": False}, r"signal\(\) has shape \(6, 5\).*reshape"),
        ({"scalar": False}, r"penalty\(\) has shape \(5,\).*scalar"),
        ({"per_pixel": False}, r"shape \(2, 1\) for 2 pixel indices"),
    ],
)
def test_signal_model_of_wrong_shapes_is_refused_at_once(wrong: dict[str, bool], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        noiseflow.fit(noiseflow.Gaussian(), Wrong(**wrong), torch.rand(6, 5))


class Returning(nn.Module):
    """A signal model that returns something else than signals, or a penalty that is none."""

    def __init__(self, change: Callable[[Tensor], object], penalty: object = 0.0) -> None:
        super().__init__()
        self.level, self.change, self.given = nn.Parameter(torch.ones(30)), change, penalty

    def forward(self, pixels: Tensor) -> object:
        return self.change(self.level[pixels])

    def penalty(self) -> object:
        return self.given


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (nn.Identity(), r"Identity\(pixels\) returns torch.int64"),  # the indices of the pixels
        (Returning(lambda each: each.half()), "returns torch.float16"),
        (Returning(lambda each: each + 0j), "returns torch.complex64"),
        (Returning(lambda each: each.tolist()), "returns list"),
        (Returning(lambda each: None), "returns NoneType"),
        (Returning(lambda each: each, None), r"penalty\(\) returns NoneType"),
        (Returning(lambda each: each * math.nan), "no finite signal"),
    ],
)
def test_signal_model_without_signals_is_refused(model: nn.Module, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        noiseflow.fit(noiseflow.SignalDependentGaussian(), model, torch.rand(6, 5))


def test_group_of_parameters_without_a_rate_learns_at_that_of_the_fit() -> None:
    fitted, observation = [], torch.rand(6, 5)
    for group in ({}, {"lr": 0.2}):
        model = Returning(lambda each: each)
        model.parameter_groups = lambda own=model, rate=group: [{"params": [own.level], **rate}]
        noiseflow.fit(noiseflow.Gaussian(), model, observation, learning_rate=0.2, num_steps=10)
        fitted.append(model.level.detach())
    assert torch.equal(*fitted)


def test_what_is_no_signal_model_is_refused() -> None:
    with pytest.raises(TypeError, match="torch module"):
        noiseflow.fit(noiseflow.Gaussian(), "clean.tif", torch.rand(6, 5))
