"""One check function per protocol: every implementation must pass it."""

from __future__ import annotations

import itertools
import math

import numpy as np
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
