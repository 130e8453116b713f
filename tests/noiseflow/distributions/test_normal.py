"""The standard normal law far into its tails: values and derivatives, backward and forward, against mpmath."""

from __future__ import annotations

import math

import mpmath
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from noiseflow.distributions.numerics.normal import (
    log_normal_cdf,
    log_normal_interval,
    normal_hazard,
    normal_quadrature,
)

mpmath.mp.dps = 80
PLACES = [-3e4, -9e3, -200.0, -6.0, -1.3, 0.0, 0.7, 5.0]
INTERVALS = [
    (-41.0, -40.0),
    (-40.0, -39.999),
    (-9.0, -3.0),
    (-3.0, -1.5),
    (-3.0, -2.98),
    (-1.0, 0.4),
    (-0.7, 0.7),
    (-0.02, 0.05),
    (-0.4, 1.0),
    (1.5, 3.0),
    (2.98, 3.0),
    (39.0, 41.0),
    (-math.inf, -1.2),
    (-math.inf, 2.0),
    (1.1, math.inf),
    (-0.3, math.inf),
]


def numbers(*values: float) -> list[Tensor]:
    return [torch.tensor(value, dtype=torch.float64) for value in values]


def exact_interval(low: float, high: float) -> mpmath.mpf:
    """Φ(high) − Φ(low), taken left of zero, where nothing cancels."""
    low, high = (-high, -low) if low > 0 else (low, high)
    root = mpmath.sqrt(2)
    return (mpmath.erfc(-mpmath.mpf(high) / root) - mpmath.erfc(-mpmath.mpf(low) / root)) / 2


@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_intervals_and_their_slopes_are_exact(low: float, high: float) -> None:
    mass = exact_interval(low, high)
    slopes = [float(sign * mpmath.npdf(end) / mass) for sign, end in ((-1, low), (1, high))]
    ends = [end.requires_grad_() for end in numbers(low, high)]
    value = log_normal_interval(*ends)
    # narrow intervals are expanded to the fourth order of their width
    assert float(value.detach()) == pytest.approx(float(mpmath.log(mass)), rel=1e-7, abs=1e-7)
    value.mul(3).backward()
    for end, slope in zip(ends, slopes, strict=True):
        if math.isfinite(float(end)):
            assert float(end.grad) == pytest.approx(3 * slope, rel=1e-6)
    tangents = [0.3 if math.isfinite(low) else 0.0, -0.2 if math.isfinite(high) else 0.0]
    expected = sum(t * s for t, s in zip(tangents, slopes, strict=True) if t)
    _, forward = torch.func.jvp(log_normal_interval, tuple(numbers(low, high)), tuple(numbers(*tangents)))
    assert float(forward) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("low", "high"), [pair for pair in INTERVALS if all(map(math.isfinite, pair)) and pair[1] < 9])
def test_second_derivatives_of_intervals_are_those_of_the_first(low: float, high: float) -> None:
    ends = tuple(end.requires_grad_() for end in numbers(low, high))
    assert torch.autograd.gradgradcheck(log_normal_interval, ends, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("x", PLACES)
def test_hazard_and_its_derivatives_are_exact(x: float) -> None:
    (place,) = numbers(x)
    exact = mpmath.npdf(x) / (mpmath.erfc(-mpmath.mpf(x) / mpmath.sqrt(2)) / 2)
    slope = float(-exact * (x + exact))
    assert float(normal_hazard(place)) == pytest.approx(float(exact), rel=1e-12)
    place.requires_grad_()
    # of x + h few digits are left far to the left, and beyond −10⁴ it is −1/x to the order of 1/x³
    near = {"rel": 1e-7, "abs": 1e-12}
    (found,) = torch.autograd.grad(2 * normal_hazard(place), place)
    assert float(found) == pytest.approx(2 * slope, **near)
    _, forward = torch.func.jvp(normal_hazard, (place.detach(),), tuple(numbers(0.3)))
    assert float(forward) == pytest.approx(0.3 * slope, **near)
    (by_cdf,) = torch.autograd.grad(2 * log_normal_cdf(place), place, create_graph=True)
    assert float(by_cdf.detach()) == pytest.approx(2 * float(exact), rel=1e-12)
    assert float(torch.autograd.grad(by_cdf, place)[0]) == pytest.approx(2 * slope, **near)
    value, forward = torch.func.jvp(log_normal_cdf, (place.detach(),), tuple(numbers(0.3)))
    assert float(forward) == pytest.approx(0.3 * float(exact), rel=1e-12)
    assert float(value) == pytest.approx(float(mpmath.log(mpmath.npdf(x) / exact)), rel=1e-12)


def test_the_quadrature_has_the_moments_of_the_normal_law() -> None:
    nodes, weights = normal_quadrature(torch.float64)
    assert nodes.shape == weights.shape
    for power, moment in enumerate([1, 0, 1, 0, 3, 0, 15, 0, 105]):
        assert float((weights * nodes**power).sum()) == pytest.approx(moment, rel=1e-12, abs=1e-12)
    assert float((weights * nodes.exp()).sum()) == pytest.approx(math.exp(0.5), rel=1e-12)
    single = normal_quadrature(torch.float32)
    assert_close(single[1], weights.float())
    assert single[0].dtype == torch.float32


@pytest.mark.parametrize(("low", "high"), [(-40.0, -39.0), (-9.0, -3.0), (-312.0, -300.0), (30.0, 30.5), (-1.0, 0.4)])
def test_slopes_of_intervals_keep_their_digits_in_single_precision(low: float, high: float) -> None:
    ends = [torch.tensor(end, requires_grad=True) for end in (low, high)]
    wide = [torch.tensor(end, dtype=torch.float64, requires_grad=True) for end in (low, high)]
    for pair in (ends, wide):
        log_normal_interval(*pair).backward()
    for found, exact in zip(ends, wide, strict=True):
        assert float(found.grad) == pytest.approx(float(exact.grad), rel=2e-5, abs=1e-12)
