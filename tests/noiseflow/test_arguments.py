"""Arguments out of range, pixels that cannot be used, and metrics of bad inputs: each is one clear error."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import noiseflow
from noiseflow import metrics
from noiseflow.models.wrapped import wrapping

SIGNAL = torch.linspace(0, 1, 5000)
OBSERVATION = SIGNAL + 0.1 * torch.randn(5000, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    "argument",
    [
        {"held_out": 0},
        {"held_out": 1.5},
        {"held_out": torch.full((5000,), 0.3)},
        {"held_out": torch.zeros(5000, dtype=torch.bool)},
        {"held_out": torch.ones(5000, dtype=torch.bool)},
        {"condition": 3.0},
        {"num_steps": -3},
        {"num_steps": 2.5},
        {"batch_size": 0},
        {"learning_rate": -1.0},
        {"learning_rate": float("nan")},
        {"learning_rate": "fast"},
        {"warm_up": 2},
        {"warm_up": 1.0},
        {"warm_up": -0.1},
        {"warm_up": float("nan")},
        {"noise_interval": 0},
        {"noise_steps": -1},
        {"mask": torch.linspace(0, 1, 5000)},
        {"mask": torch.ones(4999, dtype=torch.bool)},
    ],
    ids=str,
)
def test_fit_names_the_argument_that_is_wrong(argument: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(argument))):
        noiseflow.fit(noiseflow.Gaussian(), SIGNAL, OBSERVATION, **({"num_steps": 3} | argument))


def test_select_checks_its_arguments_too() -> None:
    for argument in ({"held_out": 1.5}, {"num_steps": -1}, {"mask": torch.full((5000,), 0.5)}):
        with pytest.raises(ValueError, match=next(iter(argument))):
            noiseflow.select(SIGNAL, OBSERVATION, candidates={"Gaussian": noiseflow.Gaussian()}, **argument)


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        ("Gaussian", {"scale": 0.0}),
        ("Gaussian", {"scale": float("nan")}),
        ("Poisson", {"gain": -1.0}),
        ("PoissonGaussian", {"gain": -1.0}),
        ("PoissonGaussian", {"read_noise": 0.0}),
        ("PoissonGaussian", {"offset": float("inf")}),
        ("ExcessNoise", {"excess_factor": 1.0}),
        ("DeadTimeCounter", {"dead_time": 1.0}),
        ("DeadTimeCounter", {"dead_time": 1.5}),
        ("Mixture", {"num_components": 0}),
        ("Mixture", {"num_components": 2.5}),
        ("RadialFlow", {"num_layers": -1}),
        ("RadialFlow", {"neighbourhood": 2}),
        ("SplineFlow", {"neighbourhood": 4}),
        ("SplineFlow", {"num_bins": 0}),
        ("SplineFlow", {"width": 0}),
        ("PhysicsFlow", {"num_bins": 0}),
    ],
)
def test_constructors_name_the_argument_that_is_wrong(kind: str, arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        getattr(noiseflow, kind)(**arguments)


def test_a_seed_in_place_of_a_generator_is_refused() -> None:
    with pytest.raises(TypeError, match="manual_seed"):
        noiseflow.Gaussian()(torch.zeros(3)).sample((2,), generator=5)  # type: ignore[arg-type]


def test_images_of_different_sizes_are_joined_by_sample_pixels() -> None:
    uneven = [SIGNAL[:4000].reshape(40, 100), SIGNAL[4000:].reshape(10, 100)]
    for function in (noiseflow.fit, metrics.evaluate):
        with pytest.raises(ValueError, match="sample_pixels"):
            function(noiseflow.Gaussian(), uneven, uneven)


def test_fit_points_to_sample_pixels_for_a_data_set() -> None:
    loader = torch.utils.data.DataLoader(torch.utils.data.TensorDataset(SIGNAL, OBSERVATION))
    with pytest.raises(ValueError, match=r"observation is missing.*sample_pixels"):
        noiseflow.fit(noiseflow.Gaussian(), loader, None)


def test_evaluation_asks_for_the_images_that_a_model_needs() -> None:
    camera = noiseflow.WithMaps(noiseflow.Gaussian(), gain=torch.ones(8, 8))
    with pytest.raises(ValueError, match="WithMaps needs whole images: give signals as images"):
        metrics.evaluate(camera, SIGNAL[:64], OBSERVATION[:64])


@pytest.mark.parametrize("kind", [torch.uint8, torch.uint16, torch.uint64, torch.int64, torch.float32])
@pytest.mark.parametrize("model", [noiseflow.Gaussian, noiseflow.SignalDependentGaussian, noiseflow.RadialFlow])
def test_signals_and_observations_of_any_number_type_are_fitted(kind: torch.dtype, model: type) -> None:
    signal = torch.linspace(20, 200, 4000).round().to(kind)
    observation = (signal + 50 * (OBSERVATION - SIGNAL)[:4000]).round().clamp(0, 255).to(kind)
    found = noiseflow.fit(model(), signal, observation, num_steps=5).noise_model
    assert float(found(torch.full((1,), 100.0)).stddev) == pytest.approx(5, rel=0.1)


def test_values_with_gradients_and_truth_values_are_numbers() -> None:
    signal, observation = (each.clone().requires_grad_() for each in (SIGNAL, OBSERVATION))
    fitted = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=5)
    assert metrics.evaluate(fitted.noise_model, signal, observation).num_pixels == SIGNAL.numel()
    lit = torch.rand(4000, generator=torch.Generator().manual_seed(0)) < 0.3
    truth = torch.full((4000,), 0.3)
    assert noiseflow.fit(noiseflow.Gaussian(), truth, lit, num_steps=5).noise_model is not None
    assert metrics.evaluate(noiseflow.Gaussian(0.5), truth, lit).num_pixels == 4000


def test_select_says_which_pixels_are_no_numbers_and_takes_equal_ones() -> None:
    observation = OBSERVATION.clone()
    observation[:5] = torch.nan
    with pytest.raises(ValueError, match="5 pixels of signal or observation are NaN or infinite; give a mask"):
        noiseflow.select(SIGNAL, observation)
    few = {"Gaussian": noiseflow.Gaussian()}
    mask = torch.isfinite(observation)
    assert noiseflow.select(SIGNAL, observation, mask=mask, candidates=few, num_steps=5).chosen.name == "Gaussian"
    assert wrapping(SIGNAL, torch.full_like(SIGNAL, 0.5)) is None


def test_exchanged_images_are_recognised() -> None:
    with pytest.raises(ValueError, match="exchanged"):
        noiseflow.fit(noiseflow.Gaussian(), OBSERVATION, SIGNAL, num_steps=3)


@pytest.mark.parametrize("low", [-1.0, 0.3])
def test_clipped_and_biased_observations_are_not_taken_for_exchanged_ones(low: float) -> None:
    observation = 1.05 * OBSERVATION.clamp(low, 0.9)
    found = noiseflow.fit(noiseflow.Gaussian(), SIGNAL, observation, num_steps=3, digitise=False)
    assert 0 < float(found.noise_model(SIGNAL).stddev.mean()) < float(observation.std())


def test_few_clipped_observations_are_not_taken_for_exchanged_ones() -> None:
    """Of 1000 pixels, clipped observations look as unbiased as a signal does."""
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        signal = torch.rand(1000, generator=generator)
        deviation = 2 * torch.sqrt(0.03**2 + 0.07**2 * signal) * torch.randn(1000, generator=generator)
        observation = (signal + deviation).clamp(0.1, 0.9)
        found = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=1, digitise=False)
        assert 0 < float(found.noise_model(signal).stddev.mean()) < 0.3


def test_exchanged_images_of_little_noise_are_recognised() -> None:
    with pytest.raises(ValueError, match="exchanged"):
        metrics.evaluate(noiseflow.Gaussian(0.04), SIGNAL + 0.5 * (OBSERVATION - SIGNAL), SIGNAL)


@pytest.mark.parametrize(
    "change", [lambda each: each + 0j, lambda each: each.to("meta"), lambda each: each.to_sparse()]
)
def test_tensors_without_real_numbers_are_refused(change: Callable[[Tensor], Tensor]) -> None:
    with pytest.raises(ValueError, match="real numbers"):
        noiseflow.Gaussian()(change(SIGNAL))
    for pair in ((SIGNAL, change(OBSERVATION)), (change(SIGNAL), OBSERVATION)):
        with pytest.raises(ValueError, match="real numbers"):
            noiseflow.fit(noiseflow.Gaussian(), *pair, num_steps=3)
        with pytest.raises(ValueError, match="real numbers"):
            metrics.evaluate(noiseflow.Gaussian(), *pair)


@pytest.mark.parametrize("signal", ["path.tif", None, np.array(["a"])])
def test_what_is_no_array_is_no_signal(signal: Any) -> None:
    with pytest.raises(ValueError, match="not real-valued"):
        noiseflow.SplineFlow()(signal)


def test_transposed_images_and_masks_are_refused() -> None:
    signal, observation = SIGNAL.reshape(50, 100), OBSERVATION.reshape(50, 100)
    for call in (metrics.evaluate, metrics.pixel_log_prob, metrics.spatial.spatial_structure):
        with pytest.raises(ValueError, match="shapes must be equal"):
            call(noiseflow.Gaussian(0.1), signal, observation.T)
    for name in ("mask", "held_out", "weights"):
        with pytest.raises(ValueError, match="must be equal: "):
            noiseflow.fit(noiseflow.Gaussian(), signal, observation, **{name: torch.ones(100, 50)})
    noiseflow.fit(noiseflow.Gaussian(), signal, observation, mask=torch.ones(5000))  # flat pixels have one order


def test_functions_and_classes_are_no_noise_models() -> None:
    for wrong in (noiseflow.Gaussian, None, lambda signal: torch.distributions.Normal(signal, 1.0)):
        for call in (noiseflow.fit, metrics.evaluate):
            with pytest.raises(TypeError, match="a noise model is a torch module"):
                call(wrong, SIGNAL, OBSERVATION)


def test_parameters_in_half_precision_are_not_fitted() -> None:
    with pytest.raises(ValueError, match="half precision"):
        noiseflow.fit(noiseflow.ExcessNoise().half(), SIGNAL, OBSERVATION)


def test_fits_take_no_notice_of_inference_mode() -> None:
    models = noiseflow.Gaussian(), noiseflow.Gaussian()
    noiseflow.fit(models[0], SIGNAL, OBSERVATION)
    with torch.inference_mode():
        noiseflow.fit(models[1], SIGNAL * 1, OBSERVATION * 1)
    assert torch.equal(models[0].log_scale, models[1].log_scale)


def test_images_without_a_pixel_have_no_spatial_structure() -> None:
    image = torch.full((8, 8), math.nan)
    for missing in (image, np.ma.masked_all((8, 8)), image[:0]):
        with pytest.raises(ValueError, match="no pixels"):
            metrics.spatial.spatial_structure(noiseflow.Gaussian(), torch.zeros(missing.shape), missing)
    with pytest.raises(ValueError, match="no image axes"):
        metrics.spatial.correlation_kernel(noiseflow.Gaussian(), torch.zeros(9), torch.zeros(9))
    with pytest.raises(ValueError, match="reach is -1"):
        metrics.spatial.correlation_kernel(noiseflow.Gaussian(), torch.zeros(9, 9), torch.zeros(9, 9), reach=-1)


def test_pixels_whose_precision_hides_the_noise_are_refused() -> None:
    signal = 3e4 + SIGNAL.double()
    observation = signal + 1e-3 * torch.randn(5000, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    noise_model = noiseflow.Gaussian(1e-3)
    assert metrics.evaluate(noise_model, signal, observation).nll == pytest.approx(-5.49, abs=0.03)
    with pytest.raises(ValueError, match="precision"):
        metrics.evaluate(noise_model, signal.float(), observation.float())


@pytest.mark.parametrize("unit", [1e-100, 1e-40, 1e100, 1e300])
@pytest.mark.parametrize("estimate", [noiseflow.fit, lambda model, *images: noiseflow.select(*images)])
def test_pixels_beyond_the_range_of_single_precision_are_refused(unit: float, estimate: Any) -> None:
    signal = torch.linspace(0.2, 1, 4000, dtype=torch.float64)
    observation = signal + 0.1 * torch.randn(4000, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="another unit"):
        estimate(noiseflow.SignalDependentGaussian(), unit * signal, unit * observation)


def test_constructors_leave_the_global_random_state_alone() -> None:
    before = torch.get_rng_state()
    for kind in ("SplineFlow", "RadialFlow", "Mixture", "PhysicsFlow", "SignalDependentGaussian"):
        getattr(noiseflow, kind)()
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    ("p", "q"),
    [
        ([5, 5], [0.5, 0.5]),
        ([float("nan"), 1.0], [0.5, 0.5]),
        ([-0.5, 1.5], [0.5, 0.5]),
        ([0.5, 0.5], [0.25, 0.25, 0.5]),
        (0.5, 0.5),
        (np.array([0.5 + 0j, 0.5]), [0.5, 0.5]),
    ],
)
def test_distances_refuse_what_is_no_probability(p: Any, q: Any) -> None:
    for distance in (metrics.jensen_shannon, metrics.bhattacharyya):
        with pytest.raises(ValueError, match=r"give|divide|convert"):
            distance(p, q)


def test_distances_take_lists() -> None:
    assert float(metrics.jensen_shannon([0.5, 0.5], [0.5, 0.5])) == 0
    assert float(metrics.bhattacharyya([1, 0], [0, 1])) == 0
    assert metrics.kolmogorov_smirnov([0.5]) == 0.5
    for values in ([], [0.5, 2.0], [0.5, float("nan")]):
        with pytest.raises(ValueError, match="integral transform"):
            metrics.kolmogorov_smirnov(values)


def test_divergence_takes_images_and_masks() -> None:
    signal, observation = (each.reshape(50, 100).numpy() for each in (SIGNAL, OBSERVATION))
    whole = metrics.divergence(noiseflow.Gaussian(0.1), signal, observation)
    spoilt = observation.copy()
    spoilt[0] = 100.0
    masked = np.ma.masked_array(spoilt, mask=spoilt == 100.0)
    assert whole.jsd < 2 * whole.jsd_floor
    found = metrics.divergence(noiseflow.Gaussian(0.1), signal, masked)
    assert found.jsd < 2 * found.jsd_floor


def test_tails_show_what_the_divergence_does_not() -> None:
    """Five pixels in a thousand are ten times wider."""
    random = torch.Generator().manual_seed(2)
    noise = torch.randn(40_000, generator=random)
    noise[:200] *= 10
    found = metrics.evaluate(noiseflow.Gaussian(float(noise.std())), torch.zeros(40_000), noise, num_signal_bins=1)
    tail = found.tails[0]
    assert tail.observed[1] > 10 * tail.expected[1]
    assert tail.p_value[1] < 1e-6
    fair = metrics.evaluate(noiseflow.Gaussian(1.0), torch.zeros(40_000), torch.randn(40_000, generator=random))
    assert min(p for tail in fair.tails for p in tail.p_value) > 1e-4


def test_weights_count_as_repeated_pixels() -> None:
    """Noise of two widths: with weights, the fit is that of the pixels repeated."""
    random = torch.Generator().manual_seed(3)
    width = torch.where(torch.arange(20_000) % 2 == 0, 0.1, 0.3)
    signal = torch.rand(20_000, generator=random)
    observation = signal + width * torch.randn(20_000, generator=random)
    weights = torch.where(width < 0.2, 3, 1)
    result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, weights=weights)
    found = float(result.noise_model.log_scale.exp())
    assert found == pytest.approx(math.sqrt((3 * 0.1**2 + 0.3**2) / 4), rel=0.03)
    narrow = noiseflow.fit(noiseflow.SplineFlow(), signal, observation, weights=(width < 0.2).int())
    spread = narrow.noise_model(torch.tensor(0.5)).variance.sqrt()
    assert float(spread) == pytest.approx(0.1, rel=0.05)


def test_weights_that_cannot_be_used_are_refused() -> None:
    for weights in (-OBSERVATION, torch.zeros(5000), torch.ones(4999), torch.full((5000,), torch.nan)):
        with pytest.raises(ValueError, match="weights"):
            noiseflow.fit(noiseflow.Gaussian(), SIGNAL, OBSERVATION, weights=weights)
    signals, images = SIGNAL.reshape(50, 100), OBSERVATION.reshape(50, 100)
    with pytest.raises(ValueError, match="weights"):
        noiseflow.fit(noiseflow.ScanNoise(noiseflow.Gaussian()), signals, images, weights=torch.ones(5000))
    with pytest.raises(ValueError, match="weights"):
        noiseflow.fit(noiseflow.Gaussian(), noiseflow.StaticScene(images), images, weights=torch.ones(5000))


@pytest.mark.parametrize("kind", ["Gaussian", "Poisson", "PoissonGaussian", "ExcessNoise", "DeadTimeCounter"])
@pytest.mark.parametrize("others", [0, 1])
def test_models_of_single_pixels_take_weights_that_drop_or_repeat(kind: str, others: int) -> None:
    """Weights 3 and 0 are the fit of some pixels alone; weights 3 and 1 are that of these pixels repeated."""
    random = torch.Generator().manual_seed(4)
    signal = 1.0 + 20 * torch.rand(2000, generator=random)
    good = torch.arange(2000) % 2 == 0
    observation = torch.poisson(torch.where(good, signal, signal / 4), generator=random) * torch.where(good, 1.0, 4.0)
    if kind not in ("Poisson", "DeadTimeCounter"):
        observation += 2 * torch.randn(2000, generator=random)
    held_out, times = torch.arange(2000) % 10 < 2, torch.where(good, 3 if others else 1, others)
    make, options = getattr(noiseflow, kind), {"digitise": False}
    weighted = noiseflow.fit(
        make(), signal, observation, weights=torch.where(good, 3.0, others), held_out=held_out, **options
    )
    given = (each.repeat_interleave(times) for each in (signal, observation))
    repeated = noiseflow.fit(make(), *given, held_out=held_out.repeat_interleave(times), **options)
    at = torch.tensor([2.0, 10.0, 20.0])
    for name in ("mean", "variance"):
        one, other = (getattr(each.noise_model(at), name) for each in (weighted, repeated))
        torch.testing.assert_close(one, other, rtol=1e-4, atol=0)
    assert weighted.held_out_nll == pytest.approx(repeated.held_out_nll, abs=1e-5)


def test_evaluation_counts_the_pixels_where_the_model_extrapolates() -> None:
    noise_model = noiseflow.fit(
        noiseflow.Mixture(1), SIGNAL[1000:4000], OBSERVATION[1000:4000], num_steps=10
    ).noise_model
    assert metrics.evaluate(noise_model, SIGNAL, OBSERVATION).num_outside == 2000
    assert metrics.evaluate(noiseflow.Gaussian(), SIGNAL, OBSERVATION).num_outside == 0
