"""Models that look beyond one pixel: maps of gain and offset, offsets of rows and columns, and the neighbourhood of a pixel."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import Digitised, Gaussian, RadialFlow, ScanNoise, SplineFlow, WithMaps, metrics
from noiseflow.distributions.pixels import PickedSignal, pick, windows_of
from noiseflow.models.scan_noise import ScanDistribution
from tests.contracts import check_intervals, check_moments, check_quantiles
from tests.noiseflow.test_noise_models import disturbed


def scene(height: int = 96, width: int = 128, seed: int = 0) -> torch.Tensor:
    return torch.rand((height, width), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def normal(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def maps(height: int = 96, width: int = 128) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.exp(0.3 * normal(height, width, seed=2)), 5 + normal(height, width, seed=3)


@pytest.mark.parametrize("make", [lambda: Gaussian(0.2), lambda: noiseflow.PoissonGaussian(0.1, 0.0, 0.5), SplineFlow])
def test_readings_of_a_mapped_detector_are_those_of_ideal_pixels_rescaled(make) -> None:  # type: ignore[no-untyped-def]
    signal, (gain, offset) = scene(8, 9), maps(8, 9)
    inner = make().double()
    model = WithMaps(inner, gain, offset)
    ideal = inner(signal).sample(generator=torch.Generator().manual_seed(4))
    drawn = model(signal).sample(generator=torch.Generator().manual_seed(4))
    assert torch.allclose(drawn, gain * ideal + offset)
    expected = inner(signal).log_prob(ideal) - torch.log(gain)
    assert torch.allclose(model(signal).log_prob(drawn), expected, rtol=1e-7, atol=1e-7)
    stack = model(signal.expand(3, 8, 9)).sample(generator=torch.Generator().manual_seed(4))
    assert stack.shape == (3, 8, 9)


def test_mapped_detector_rounds_after_the_maps_and_keeps_the_contract() -> None:
    signal, (gain, offset) = scene(2, 3), maps(2, 3)
    model = Digitised(WithMaps(Gaussian(0.5).double(), gain, offset), step=0.5, low=4.0)
    draws = model(signal).sample((20_000,), generator=torch.Generator().manual_seed(0))
    assert torch.equal(draws, (draws * 2).round() / 2)
    for check in (check_quantiles, check_moments, check_intervals):
        check(model(signal), draws)


def test_fit_behind_maps_finds_the_noise_of_ideal_pixels() -> None:
    signal, (gain, offset) = scene(), maps()
    observation = gain * (signal + 0.1 * normal(96, 128)) + offset
    result = noiseflow.fit(WithMaps(Gaussian().double(), gain, offset), signal, observation, num_steps=50)
    assert math.exp(result.noise_model.model.log_scale.item()) == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("inner", [lambda: Gaussian(3.0), lambda: Digitised(noiseflow.PoissonGaussian(2.0, 90.0, 1.0))])
def test_large_image_behind_maps_has_the_likelihood_of_its_parts(inner) -> None:  # type: ignore[no-untyped-def]
    """It is computed in pieces, each of which needs its own part of each map."""
    (gain, offset), signal, half = maps(520, 520), 100 + 20 * scene(520, 520), 260
    variance = torch.exp(normal(520, 520, seed=5)) if not isinstance(inner(), Gaussian) else None
    model = WithMaps(inner().double(), gain, offset, variance)
    observation = (gain * signal + offset).round()
    with torch.no_grad():
        whole = model(signal).log_prob(observation)
        for rows in (slice(0, half), slice(half, None)):
            own = None if variance is None else variance[rows]
            part = WithMaps(inner().double(), gain[rows], offset[rows], own)
            assert torch.allclose(whole[rows], part(signal[rows]).log_prob(observation[rows]), atol=1e-9)


VARIANCES = torch.tensor([[0.05, 1.0, 8.0, 40.0], [400.0, 3.0, 0.3, 90.0]], dtype=torch.float64)


def test_read_noise_of_single_pixels_is_that_of_detectors_of_their_own() -> None:
    """Pixels that resolve electrons and pixels that do not, side by side."""
    signal = torch.tensor([[3.0, 9.0, 30.0, 5.0], [60.0, 3.5, 400.0, 3.0]], dtype=torch.float64)
    gain, offset = torch.linspace(0.8, 1.3, 8, dtype=torch.float64).reshape(2, 4), 5 * torch.ones(2, 4)
    model = WithMaps(noiseflow.PoissonGaussian(2.0, 3.0, 1.0), gain, offset.double(), VARIANCES)
    observation = (model(signal).mean + torch.tensor(1.7)).requires_grad_()
    found = model(signal).log_prob(observation)
    for place in np.ndindex(2, 4):
        own = math.sqrt(VARIANCES[place]) / (float(gain[place]) * 2.0)
        alone = WithMaps(noiseflow.PoissonGaussian(2.0, 3.0, own), gain, offset.double())
        assert found[place].item() == pytest.approx(alone(signal).log_prob(observation)[place].item(), abs=1e-7)
    slope = torch.autograd.grad(found.sum(), observation)[0]
    ahead, behind = (model(signal).log_prob(observation + step) for step in (1e-4, -1e-4))
    assert torch.allclose(slope, (ahead - behind) / 2e-4, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("rounded", [False, True])
def test_density_with_a_map_of_variance_integrates_to_one_and_the_sampler_agrees(rounded: bool) -> None:
    gain, offset = torch.linspace(0.8, 1.3, 8).reshape(2, 4).double(), torch.linspace(-5, 5, 8).reshape(2, 4).double()
    inner: torch.nn.Module = noiseflow.PoissonGaussian(2.0, 100.0, 1.0)
    model = WithMaps(Digitised(inner, low=90.0) if rounded else inner, gain, offset, VARIANCES)
    signal = torch.tensor([[100.0, 104.0, 130.0, 102.0], [160.0, 103.0, 110.0, 300.0]], dtype=torch.float64)
    law = model(signal)
    step = 1.0 if rounded else 0.1
    values = torch.arange(0.0, 700.0, step, dtype=torch.float64)
    mass = step * law.log_prob(values[:, None, None].expand(-1, 2, 4)).exp().sum(0)
    assert torch.allclose(mass, torch.ones_like(mass), atol=1e-5)
    draws = law.sample((20_000,), generator=torch.Generator().manual_seed(0))
    for check in (check_quantiles, check_moments):
        check(law, draws)
    free = WithMaps(inner, gain, offset, VARIANCES)(signal)
    expected = VARIANCES + (gain * 2.0) ** 2 * (signal - 100.0) / 2.0
    assert torch.allclose(free.variance, expected)


def test_model_file_keeps_the_map_of_variance_and_has_none_where_there_is_none(tmp_path: Path) -> None:
    from safetensors import safe_open

    camera, gain = noiseflow.PoissonGaussian(2.0, 100.0, 1.0), torch.ones(2, 4)
    path = noiseflow.save(WithMaps(Digitised(camera), gain, variance=VARIANCES.float()), tmp_path / "maps.safetensors")
    again = noiseflow.load(path)
    assert torch.equal(again.variance, VARIANCES.float())
    signal = torch.full((2, 4), 130.0)
    assert again(signal).variance.std() > 10
    plain = noiseflow.save(WithMaps(Digitised(camera), gain), tmp_path / "plain.safetensors")
    with safe_open(plain, framework="pt") as file:  # as files of earlier versions
        assert not any("variance" in name for name in file.keys())  # noqa: SIM118
        assert "variance" not in file.metadata()["model"]
    assert noiseflow.load(plain).variance is None


def test_map_of_variance_needs_a_model_with_read_noise() -> None:
    with pytest.raises(ValueError, match="Gaussian has no read noise"):
        WithMaps(Gaussian(), variance=torch.ones(3, 4))(torch.zeros(3, 4))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give a gain or an offset map"),
        ({"gain": torch.ones(3, 4), "offset": torch.zeros(4, 3)}, "of equal size"),
        ({"gain": torch.zeros(3, 4)}, "not positive"),
        ({"offset": torch.full((3, 4), math.nan)}, "NaN"),
        ({"gain": torch.ones(3, 4), "variance": torch.zeros(3, 4)}, "not positive"),
        ({"gain": torch.ones(3, 4), "variance": torch.ones(4, 3)}, "of equal size"),
        *(({"gain": torch.ones(3, 4), "variance": wrong}, "positive") for wrong in (-4.0, 0.0, math.nan, math.inf)),
        ({"gain": torch.ones(3, 4), "variance": torch.tensor(-1.0)}, "positive"),
    ],
)
def test_impossible_maps_are_refused(arguments: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WithMaps(Gaussian(), **arguments)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (WithMaps(Gaussian(), torch.ones(3, 4)), "its own gain and offset"),
        (ScanNoise(Gaussian()), "every row of the image has an offset"),
        (SplineFlow(neighbourhood=3), "uses 3 x 3 pixels"),
    ],
)
def test_flat_signals_are_refused(model: torch.nn.Module, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model(torch.zeros(12))
    with pytest.raises(ValueError, match="give images"):
        noiseflow.fit(model, torch.rand(100), torch.rand(100))
    if isinstance(model, WithMaps):
        with pytest.raises(ValueError, match="crop"):
            model(torch.zeros(4, 4))


@pytest.mark.parametrize("ratio", [0.03, 1.0, 30.0])
@pytest.mark.parametrize("along", ["row", "column"])
def test_offsets_of_gaussian_rows_have_the_exact_likelihood(ratio: float, along: str) -> None:
    """A row of Gaussian readings with a Gaussian offset is a multivariate normal."""
    signal, width = scene(5, 40), 40
    model = ScanNoise(Gaussian(0.1), 0.1 * ratio, along=along).double()  # type: ignore[arg-type]
    deviation, scale = math.exp(model.model.log_scale.item()), math.exp(model.log_scale.item())
    turned = signal if along == "row" else signal.T
    drawn = model(turned).sample(generator=torch.Generator().manual_seed(0))
    lines = drawn if along == "row" else drawn.T
    covariance = deviation**2 * torch.eye(width, dtype=torch.float64) + scale**2
    exact = torch.distributions.MultivariateNormal(signal, covariance).log_prob(lines)
    with torch.no_grad():
        found = model(turned).log_prob(drawn)
        lines_found = model(turned).line_log_prob(drawn)
    assert torch.allclose(found.sum(-1 if along == "row" else -2), exact, rtol=0, atol=1e-6)
    assert torch.allclose(lines_found, exact, rtol=0, atol=1e-6)
    first = torch.distributions.Normal(signal[:, 0], math.hypot(deviation, scale)).log_prob(lines[:, 0])
    assert torch.allclose((found if along == "row" else found.T)[:, 0], first, rtol=0, atol=1e-7)


@pytest.mark.parametrize("inner", ["spline", "digitised"])
def test_offsets_of_any_rows_agree_with_a_plain_integral(inner: str) -> None:
    base = disturbed(SplineFlow(), 0.1)
    if inner == "digitised":
        base = Digitised(base, step=0.05, low=0.0)
    model = ScanNoise(base, 0.2).double()
    signal = scene(2, 12)
    drawn = model(signal).sample(generator=torch.Generator().manual_seed(0))
    offsets = torch.linspace(-1.6, 1.6, 1601, dtype=torch.float64)
    with torch.no_grad():
        at = torch.stack([base(signal).rescaled(torch.ones(1), b).log_prob(drawn).sum(-1) for b in offsets])
        prior = torch.distributions.Normal(0.0, model.log_scale.exp()).log_prob(offsets)
        exact = torch.logsumexp(at + prior[:, None], 0) + math.log(float(offsets[1] - offsets[0]))
        assert torch.allclose(model(signal).log_prob(drawn).sum(-1), exact, rtol=0, atol=4e-3)
        assert torch.allclose(model(signal).line_log_prob(drawn), exact, rtol=0, atol=8e-3)


def test_missing_readings_of_a_row_count_nothing() -> None:
    model = ScanNoise(Gaussian(0.1), 0.2).double()
    signal = scene(3, 10)
    drawn = model(signal).sample(generator=torch.Generator().manual_seed(0))
    broken = drawn.clone()
    broken[:, 4] = math.nan
    kept = [i for i in range(10) if i != 4]
    with torch.no_grad():
        found = model(signal).line_log_prob(broken)
        assert torch.allclose(found, model(signal[:, kept]).line_log_prob(drawn[:, kept]), atol=1e-8)


def test_single_readings_of_a_row_follow_their_own_law() -> None:
    model = ScanNoise(Gaussian(0.1), 0.2).double()
    signal = scene(1, 4)
    draws = model(signal).sample((20_000,), generator=torch.Generator().manual_seed(0))
    for check in (check_quantiles, check_moments, check_intervals):
        check(model(signal), draws)


def test_given_those_before_them_readings_of_a_row_are_uniform_and_independent() -> None:
    model = ScanNoise(Gaussian(0.1), 0.3).double()
    signal = scene()
    drawn = model(signal).sample(generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        u = model(signal).conditional_cdf(drawn)[1]
    assert metrics.kolmogorov_smirnov(u.reshape(-1).numpy()) < 2 / math.sqrt(u.numel())
    means = torch.special.ndtri(u).mean(-1)
    assert float(means.var() * u.shape[-1]) == pytest.approx(1, abs=0.5)


@pytest.mark.parametrize("along", ["row", "column"])
def test_fit_finds_offsets_of_rows_beside_the_noise(along: str) -> None:
    signal = scene(192, 128)
    shape = (192, 1) if along == "row" else (1, 128)
    observation = signal + 0.1 * normal(192, 128) + 0.05 * normal(*shape, seed=5)
    mask = torch.ones_like(signal, dtype=torch.bool)
    observation[3:5, 7:9], mask[3:5, 7:9] = math.nan, False
    model = ScanNoise(Gaussian().double(), along=along)  # type: ignore[arg-type]
    result = noiseflow.fit(model, signal, observation, mask=mask, num_steps=60)
    assert math.exp(model.log_scale.item()) == pytest.approx(0.05, rel=0.25)
    assert math.exp(model.model.log_scale.item()) == pytest.approx(0.1, rel=0.03)
    alone = noiseflow.fit(Gaussian().double(), signal, observation, mask=mask, num_steps=60)
    assert result.held_out_nll < alone.held_out_nll - 0.05


def test_rounding_is_put_inside_the_offsets_of_rows() -> None:
    signal = 20 * scene(24, 32)
    observation = (signal + 2 * normal(24, 32) + normal(24, 1, seed=5)).round()
    result = noiseflow.fit(ScanNoise(Gaussian().double()), signal, observation, num_steps=5)
    assert isinstance(result.noise_model, ScanNoise)
    assert isinstance(result.noise_model.model, Digitised)
    with pytest.raises(ValueError, match="ScanNoise"):
        Digitised(ScanNoise(Gaussian()))
    with pytest.raises(ValueError, match="already"):
        ScanNoise(ScanNoise(Gaussian()), along="column")


def test_windows_hold_the_neighbours_and_repeat_the_border() -> None:
    images = torch.arange(24.0).reshape(2, 3, 4)
    windows = windows_of(images, 3)
    padded = torch.nn.functional.pad(images[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    for frame in range(2):
        for y in range(3):
            for x in range(4):
                assert torch.equal(windows[frame, y, x], padded[frame, y : y + 3, x : x + 3].reshape(-1))
    chosen = torch.tensor([0, 5, 23])
    picked = pick(lambda index: images.reshape(-1)[index], chosen, (3, 4), 5)
    assert torch.equal(windows_of(picked, 3), windows.reshape(-1, 9)[chosen])
    assert torch.equal(picked.place, torch.tensor([0, 5, 11]))
    with pytest.raises(ValueError, match="lack the windows"):
        windows_of(PickedSignal(picked.values, picked.place), 3)


@pytest.mark.parametrize("mean_preserving", [False, True])
def test_noise_of_the_left_neighbour_is_learnt_only_with_a_neighbourhood(mean_preserving: bool) -> None:
    """The standard deviation of a pixel depends on the signal to its left."""
    signal = scene(96, 96).float()
    deviation = 0.05 + 0.3 * torch.roll(signal, 1, dims=1)
    observation = signal + deviation * normal(96, 96).float()
    options = {"num_steps": 100, "batch_size": 2048}
    blind = noiseflow.fit(RadialFlow(2, mean_preserving=mean_preserving), signal, observation, **options)
    seeing = RadialFlow(2, mean_preserving=mean_preserving, neighbourhood=3)
    result = noiseflow.fit(seeing, signal, observation, **options)
    entropy = float(torch.log(deviation[:, 1:]).mean()) + 0.5 * math.log(2 * math.pi * math.e)
    assert result.held_out_nll < blind.held_out_nll - 0.1
    assert result.held_out_nll == pytest.approx(entropy, abs=0.1)
    if mean_preserving:
        part = signal[:8, :8].double()
        inner = seeing.double()(part)
        assert float(((inner.mean - part) / inner.stddev).detach().abs().max()) < 1e-4


def test_static_scene_and_noise_with_maps_are_learnt_together() -> None:
    clean, (_, offset) = scene(24, 24), maps(24, 24)
    observation = clean + offset + 0.2 * normal(16, 24, 24)
    start = noiseflow.StaticScene(observation - offset).double()
    model = WithMaps(Gaussian().double(), offset=offset)
    noiseflow.fit(model, start, observation, num_steps=40)
    assert float((start.image() - clean).square().mean().sqrt()) == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize(
    "make",
    [
        lambda: WithMaps(SplineFlow(), *(each.float() for each in maps(6, 7))),
        lambda: ScanNoise(Digitised(Gaussian(), 0.1, low=0.0), 0.03, along="column"),
        lambda: SplineFlow(neighbourhood=3, mean_preserving=True),
        lambda: ScanNoise(WithMaps(noiseflow.SignalDependentGaussian(neighbourhood=5), maps(6, 7)[0].float())),
    ],
)
def test_saved_models_come_back_the_same(make, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    model = disturbed(make(), 0.1).float()
    noiseflow.save(model, tmp_path / "model.safetensors")
    again = noiseflow.load(tmp_path / "model.safetensors")
    signal = scene(6, 7).float()
    observation = model(signal).sample(generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert torch.equal(again(signal).log_prob(observation), model(signal).log_prob(observation))


def test_distribution_of_rows_has_the_images_shape() -> None:
    distribution = ScanNoise(Gaussian())(torch.zeros(2, 3, 4))
    assert isinstance(distribution, ScanDistribution)
    assert distribution.batch_shape == (2, 3, 4)
    assert distribution.sample((5,)).shape == (5, 2, 3, 4)
    shared = distribution.sample((1000,), torch.Generator().manual_seed(0)).numpy()
    assert np.corrcoef(shared[:, 0, 0, 0], shared[:, 0, 0, 3])[0, 1] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("along", ["row", "column"])
def test_bands_of_lines_are_evaluated_like_whole_images(along: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = ScanNoise(Digitised(Gaussian(0.4), step=1.0, low=0.0), 0.7, along=along).double()  # type: ignore[arg-type]
    signal = 3 * scene(24, 30).reshape(2, 12, 30)
    drawn = model(signal).sample((2,), generator=torch.Generator().manual_seed(0))
    drawn[0, 1, 3, 4] = math.nan
    with torch.no_grad():
        whole = model(signal).conditional(drawn)
        monkeypatch.setattr(ScanDistribution._in_bands, "__kwdefaults__", {"pixels": 150})
        parts = model(signal).conditional(drawn)
        assert torch.equal(model(signal).log_prob(drawn), parts[0])
    assert all(torch.allclose(a, b, atol=1e-9, equal_nan=True) for a, b in zip(whole, parts, strict=True))
    assert torch.equal(model(signal).conditional_cdf(drawn)[0].isnan(), drawn.isnan())
