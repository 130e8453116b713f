"""One check function per protocol: every implementation must pass it."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn


def check_transform(transform, x: Tensor, *, tolerance: float = 1e-10, slope_tolerance: float = 1e-8) -> None:
    """Inverse, log-derivative against autograd, and monotonicity of a transform at increasing points (N,)."""
    x = x.clone().requires_grad_()
    y, ladj = transform.forward(x)
    (slope,) = torch.autograd.grad(y.sum(), x)
    assert torch.allclose(ladj, torch.log(slope), rtol=0, atol=slope_tolerance)
    assert bool((torch.diff(y.detach()) > 0).all())
    back, ladj_back = transform.inverse(y.detach())
    assert float((back - x.detach()).abs().max() / (1 + x.detach().abs().max())) < tolerance
    assert torch.allclose(ladj_back, -ladj.detach(), rtol=0, atol=10 * slope_tolerance)


def integrate_density(model: nn.Module, signal: float, *, tolerance: float = 1e-12) -> float:
    """∫ p(o | signal) do by adaptive Simpson's rule: intervals are halved until the rule and its trapezoid agree."""

    def density(at: Tensor) -> Tensor:
        return model(torch.full_like(at, signal)).log_prob(at).exp()

    latent = torch.linspace(-9, 9, 4001, dtype=torch.float64)
    edges = model(torch.full_like(latent, signal)).from_latent(latent)
    left, right, total = edges[:-1], edges[1:], 0.0
    at_left, at_right = density(left), density(right)
    while left.numel():
        middle = (left + right) / 2
        at_middle = density(middle)
        simpson = (right - left) * (at_left + 4 * at_middle + at_right) / 6
        rough = ((right - left) * (at_left - 2 * at_middle + at_right)).abs() > tolerance
        rough &= (middle > left) & (middle < right)
        total += float(simpson[~rough].sum())
        left, right = torch.cat([left[rough], middle[rough]]), torch.cat([middle[rough], right[rough]])
        at_left, at_right = (
            torch.cat([at_left[rough], at_middle[rough]]),
            torch.cat([at_middle[rough], at_right[rough]]),
        )
    return total


def check_noise_model(model: nn.Module, signals: Tensor, *, seed: int = 0) -> None:
    """Shapes, finiteness, quantiles, moments and sampler of a noise model, in float64, at the given (N,) signals."""
    distribution = model(signals)
    assert distribution.batch_shape == signals.shape
    assert distribution.event_shape == ()
    generator = torch.Generator().manual_seed(seed)
    draws = distribution.sample((20_000,), generator=generator)
    assert draws.shape == (20_000, *signals.shape)
    again = distribution.sample((20_000,), generator=torch.Generator().manual_seed(seed))
    assert torch.equal(draws, again)
    check_sampler(model, signals, draws)
    check_quantiles(distribution, draws)
    check_moments(distribution, draws)
    check_intervals(distribution, draws)


def check_sampler(model: nn.Module, signals: Tensor, draws: Tensor) -> None:
    """Kolmogorov–Smirnov: the draws follow the model's own CDF (at a level that one run in 10⁵ misses)."""
    from noiseflow.metrics.evaluation import kolmogorov_smirnov, probability_integral_transform

    for column in range(signals.numel()):
        observed = draws[:, column].contiguous()
        u = probability_integral_transform(
            model, signals[column].expand(observed.shape), observed, np.random.default_rng(1)
        )
        assert kolmogorov_smirnov(u) < 2.5 / math.sqrt(u.size)


def check_quantiles(distribution, draws: Tensor) -> None:
    """The CDF reaches u at the quantile of u, and not before it."""
    for u in (0.01, 0.3, 0.7, 0.99):
        level = torch.full(distribution.batch_shape, u, dtype=draws.dtype)
        with torch.no_grad():  # while it learns, a mean-preserving model solves for the mean at fewer signals
            quantile = distribution.icdf(level)
            assert bool((distribution.cdf(quantile) >= u - 1e-6).all())
            assert bool((distribution.cdf_below(quantile) <= u + 1e-6).all())


def check_moments(distribution, draws: Tensor) -> None:
    """Mean and variance agree with the draws to five standard errors."""
    error = draws.std(0) / math.sqrt(draws.shape[0])
    assert bool(((distribution.mean - draws.mean(0)).abs() < 5 * error + 1e-9).all())
    centred = (draws - draws.mean(0)) ** 2
    error = centred.std(0) / math.sqrt(draws.shape[0])
    assert bool(((distribution.variance - centred.mean(0)).abs() < 5 * error + 1e-9).all())


def check_intervals(distribution, draws: Tensor) -> None:
    """Interval masses agree with the CDF and sum to one."""
    inner = torch.quantile(draws, torch.tensor([0.1, 0.5, 0.9], dtype=draws.dtype), dim=0) + 1e-4 * draws.std(0)
    infinity = torch.full_like(inner[:1], math.inf)
    edges = torch.cat([-infinity, inner, infinity])
    masses = torch.stack([distribution.log_interval_prob(a, b).exp() for a, b in itertools.pairwise(edges)])
    assert torch.allclose(masses.sum(0), torch.ones_like(masses[0]), atol=1e-6)
    assert torch.allclose(masses[0], distribution.cdf(inner[0]), atol=1e-6)


def check_traits(model, signals: Tensor, observation: Tensor) -> None:
    """The traits of a noise model agree with one another and with what it does; signals and observations of one image."""
    from noiseflow import NoiseModelBase
    from noiseflow.distributions import NoiseDistribution

    assert isinstance(model, NoiseModelBase)
    for name in (
        "needs_image",
        "describes_single_readings",
        "standardises_by_level",
        "starts_most_likely",
        "starts_anew",
    ):
        assert isinstance(getattr(model, name), bool), name
    assert model.learning_rate > 0
    assert model.joint_learning_rate > 0
    assert model.num_steps >= 1
    assert model.most_joint_steps is None or model.most_joint_steps >= 1
    assert model.neighbourhood % 2 == 1
    assert model.shared_axis in (None, -1, -2)
    assert model.needs_image or (model.neighbourhood == 1 and model.shared_axis is None)
    assert model.step >= 0
    assert model.low < model.high
    free = model.without_rails()
    assert (free.low, free.high, free.step) == (-math.inf, math.inf, model.step)
    bare = model.one_pixel
    assert not bare.needs_image or bare.neighbourhood > 1
    assert (bare.step, bare.low, bare.high) == (0.0, -math.inf, math.inf)
    assert bare.without_converter() is bare
    assert model.learns == any(parameter.requires_grad for parameter in model.parameters())
    assert isinstance(model(signals), NoiseDistribution)
    try:
        model(signals.reshape(-1))
        assert not model.needs_image
    except ValueError:
        assert model.needs_image
    check_fixed_part(model, signals.reshape(-1), observation.reshape(-1))


def check_fixed_part(model, signal: Tensor, observation: Tensor) -> None:
    """The likelihood from what does not change is the likelihood."""
    if model.needs_image:
        return
    fixed = model.fixed_part(signal, observation)
    if fixed is not None:
        found = model.log_prob_from(signal, fixed)
        assert torch.allclose(found, model(signal).log_prob(observation), atol=1e-5)


def check_distribution(distribution) -> None:
    """All that torch asks of a distribution: entropy, mode, divergence, support, expansion, a telling repr; (N,) float64."""
    generator = torch.Generator().manual_seed(0)
    draws = distribution.sample(4000, generator=generator)
    log_prob = distribution.log_prob(draws)
    error = log_prob.std(0) / math.sqrt(4000)
    assert bool(((distribution.entropy() + log_prob.mean(0)).abs() < 5 * error + 1e-6).all())
    assert bool((distribution.log_prob(distribution.mode) >= log_prob.amax(0) - 1e-6).all())
    assert bool(distribution.support.check(draws).all())
    with torch.no_grad():
        assert torch.allclose(torch.distributions.kl_divergence(distribution, distribution), torch.zeros_like(error))
    assert distribution.event_shape == ()
    wide = distribution.expand((2, *distribution.batch_shape))
    assert wide.batch_shape == (2, *distribution.batch_shape)
    assert torch.equal(wide.log_prob(draws[:2]), distribution.log_prob(draws[:2]))
    one, other = wide.sample(generator=generator)
    assert not torch.equal(one, other)
    assert str(draws.shape[-1]) in repr(distribution)
    low, high = distribution.icdf(torch.zeros_like(error)), distribution.icdf(torch.ones_like(error))
    assert bool((low <= draws.amin(0)).all() & (high >= draws.amax(0)).all())
    assert torch.equal(low, distribution.limits[0].expand_as(low).to(low))


def check_number_types(model: nn.Module, signals: Tensor) -> None:
    """The answers are those of the same numbers in double precision, within a few roundings of the answer and its argument."""
    import copy

    dtype, double = signals.dtype, copy.deepcopy(model).double()
    eps = torch.finfo(dtype).eps
    exact = double(signals.double())
    observation = exact.icdf(torch.full_like(signals, 0.3, dtype=torch.float64)).to(dtype)
    found, seen = model(signals), observation.double()
    for name in ("log_prob", "cdf"):
        expected, value = getattr(exact, name)(seen), getattr(found, name)(observation)
        assert value.dtype == dtype, name
        # single precision is what half precision is computed in; a cell's edge or a latent is rounded there
        assert bool(((value.double() - expected).abs() <= 4 * eps * expected.abs() + 2e-3).all()), name
    for name in ("mean", "variance"):
        expected, value = getattr(exact, name), getattr(found, name)
        assert value.dtype == dtype, name
        assert bool(((value.double() - expected).abs() <= 4 * eps * expected.abs() + 1e-4).all()), name
    assert found.sample(generator=torch.Generator().manual_seed(0)).dtype == dtype
    assert found.log_prob(seen).dtype == torch.float64
    assert found.log_prob(seen.float()).dtype == torch.float32


def check_shapes(model: nn.Module, signals: Tensor) -> None:
    """Numbers, images, several observations of one signal, and empty batches."""
    with torch.no_grad():
        whole = model(signals).log_prob(signals)
        for i in range(signals.numel()):
            assert torch.allclose(model(signals[i]).log_prob(signals[i]), whole[i], atol=1e-4, equal_nan=True)
            assert torch.allclose(model(signals[i]).log_prob(float(signals[i])), whole[i], atol=1e-4)
        assert model(signals[0]).sample(3).shape == (3,)
        crossed = model(signals).log_prob(signals[:, None])
        assert crossed.shape == (signals.numel(), signals.numel())
        assert torch.allclose(crossed.diagonal(), whole, atol=1e-4)
        nothing = model(signals[:0])
        assert nothing.log_prob(signals[:0]).shape == (0,)
        assert nothing.sample((2,)).shape == (2, 0)
        assert nothing.mean.shape == (0,)
        whole_numbers = torch.tensor([0, 1])
        expected = model(whole_numbers.float()).log_prob(whole_numbers.float())
        assert torch.allclose(model(whole_numbers).log_prob(whole_numbers), expected)
    with pytest.raises(ValueError, match="broadcast"):
        model(signals).log_prob(torch.zeros(signals.numel() + 4))


def check_bad_values(model: nn.Module, signals: Tensor) -> None:
    """NaN in, NaN out, for observations and signals alike, with the others' answers and gradients untouched; −inf beyond."""
    distribution = model(signals)
    bad = torch.tensor([math.nan, math.inf, -math.inf])
    found = distribution.log_prob(bad)
    assert bool(torch.isnan(found[0]) & torch.isneginf(found[1:]).all())
    below = distribution.cdf(bad)
    assert bool(torch.isnan(below[0]) & (below[1] == 1) & (below[2] == 0))
    assert bool(torch.isnan(distribution.icdf(bad[:1].expand(3))).all())
    with pytest.raises(ValueError, match=r"1\.5 is not a probability"):
        distribution.icdf(torch.full_like(signals, 1.5))
    for nothing in (math.nan, math.inf):
        signal = signals.clone()
        signal[1] = nothing
        signal.requires_grad_()
        mixed = model(signal).log_prob(signals)
        assert torch.isnan(mixed).tolist() == [False, True, False]
        assert torch.allclose(mixed[::2], distribution.log_prob(signals)[::2], atol=1e-4)
        mixed[::2].sum().backward()
        assert bool(torch.isfinite(signal.grad[::2]).all())
        assert bool(torch.isnan(model(signal).sample()[1]))


def check_draws_with_gradient(model: nn.Module, signals: Tensor) -> None:
    """The gradient of the mean of differentiable draws is that of the mean; discrete draws say that they have none."""
    signal = signals.clone().requires_grad_()
    distribution = model(signal)
    if not distribution.has_rsample:
        with pytest.raises(NotImplementedError, match="discrete"):
            distribution.rsample()
        return
    drawn = distribution.rsample((20_000,), generator=torch.Generator().manual_seed(0))
    again = distribution.sample((20_000,), generator=torch.Generator().manual_seed(0))
    assert torch.equal(drawn.detach(), again)
    (slope,) = torch.autograd.grad(drawn.mean(0).sum(), signal)
    step = 1e-3
    with torch.no_grad():
        expected = (model(signals + step).mean - model(signals - step).mean) / (2 * step)
    assert torch.allclose(slope, expected, atol=0.03)


def check_functional_transforms(model: nn.Module, signals: Tensor) -> None:
    """``torch.func`` grad, vmap of grad and Hessian of the log-likelihood against central differences, float64."""
    observation = (signals + 0.03).clamp(max=1.0)
    observation = (observation * 128).round() / 128

    def total(signal: Tensor) -> Tensor:
        return model(signal).log_prob(observation).sum()

    def slope(signal: Tensor) -> Tensor:
        at = signal.clone().requires_grad_()
        return torch.autograd.grad(total(at), at)[0]

    step, units = 1e-6, torch.eye(signals.numel(), dtype=signals.dtype)
    with torch.no_grad():
        expected = torch.stack([(total(signals + step * u) - total(signals - step * u)) / (2 * step) for u in units])
    curvature = torch.stack([(slope(signals + step * u) - slope(signals - step * u)) / (2 * step) for u in units])
    near = {"rtol": 1e-4, "atol": 1e-4 * float(1 + curvature.abs().max())}
    assert torch.allclose(torch.func.grad(total)(signals), expected, **near)
    one = torch.func.vmap(torch.func.grad(lambda s, o: model(s).log_prob(o)))
    assert torch.allclose(one(signals, observation), expected, **near)
    same = observation[:1].expand(signals.numel())
    of_one = torch.func.grad(lambda s: model(s).log_prob(same).sum())(signals)
    fixed = torch.func.vmap(torch.func.grad(lambda s: model(s).log_prob(observation[0])))
    assert torch.allclose(fixed(signals), of_one, **near)
    assert torch.allclose(torch.func.hessian(total)(signals), curvature, **near)
    assert torch.allclose(torch.autograd.functional.hessian(total, signals), curvature, **near)
