"""Laws of the scalar maps: inverse, log-derivative, monotone, over extremes of their parameters."""

import math
from dataclasses import fields

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from noiseflow.distributions.numerics.monotone_maps import (
    AFFINE,
    TAIL,
    Affine,
    Layer,
    Radial,
    Spline,
    StudentTail,
    _expm1_ratio,
    _log1p_ratio,
    radial_layer,
    spline_layer,
)
from tests.contracts import check_transform

POINTS = torch.linspace(-30, 30, 2003, dtype=torch.float64)
raw_numbers = st.floats(-50, 50, allow_nan=False)


def parameters(count: int) -> st.SearchStrategy[torch.Tensor]:
    return st.lists(raw_numbers, min_size=count, max_size=count).map(lambda v: torch.tensor(v, dtype=torch.float64))


@given(st.floats(-10, 10), st.floats(-5, 5))
def test_affine_is_a_transform(loc: float, log_scale: float) -> None:
    check_transform(Affine(torch.tensor(loc).double(), torch.tensor(log_scale).double()), POINTS)


@settings(max_examples=60, deadline=None)
@given(parameters(3))
def test_radial_is_a_transform(raw: torch.Tensor) -> None:
    check_transform(radial_layer(0.0).build(raw), POINTS)


@settings(max_examples=40, deadline=None)
@given(parameters(49))
def test_spline_is_a_transform(raw: torch.Tensor) -> None:
    check_transform(spline_layer(16).build(raw), POINTS, tolerance=1e-8, slope_tolerance=1e-5)


@settings(max_examples=40, deadline=None)
@given(parameters(2))
def test_tail_is_a_transform(raw: torch.Tensor) -> None:
    check_transform(TAIL.build(raw), POINTS)


@given(st.floats(0.05, 20), st.floats(-3, 3), st.floats(-1e4, 1e4))
def test_radial_agrees_with_its_formula(width: float, log_slope: float, at: float) -> None:
    alpha, z0 = torch.tensor(width).double(), torch.tensor(0.3).double()
    beta = alpha * torch.expm1(torch.tensor(log_slope).double())
    x = torch.tensor(at).double()
    d = x - z0
    y, ladj = Radial(z0[None], torch.log(alpha)[None], torch.tensor([log_slope]).double()).forward(x)
    assert torch.allclose(y, x + beta * d / (alpha + d.abs()), rtol=1e-12)
    assert torch.allclose(ladj, torch.log1p(alpha * beta / (alpha + d.abs()) ** 2), rtol=1e-9, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(parameters(9))
def test_radial_maps_in_turn_are_each_map_after_the_other(raw: torch.Tensor) -> None:
    y, total = POINTS, torch.zeros_like(POINTS)
    for one in raw.split(3):
        y, ladj = radial_layer(0.0).build(one).forward(y)
        total = total + ladj
    together = radial_layer(0.0, 0.0, 0.0).build(raw)
    for found, expected in zip(together.forward(POINTS), (y, total), strict=True):
        assert torch.allclose(found, expected, rtol=1e-12, atol=1e-12)
    check_transform(together, POINTS, tolerance=1e-7)


@settings(max_examples=60, deadline=None)
@given(parameters(3), st.floats(-1e6, 1e6))
def test_radial_inverse_keeps_its_digits_in_float32(raw: torch.Tensor, at: float) -> None:
    reference = radial_layer(0.0).build(raw)
    x64 = torch.tensor([at], dtype=torch.float64)
    y32 = reference.forward(x64)[0].float()
    x32 = radial_layer(0.0).build(raw.float()).inverse(y32)[0]
    exact = reference.inverse(y32.double())[0]
    assert float((x32 - exact).abs()) <= 1e-4 * (1 + float(exact.abs()))


@pytest.mark.parametrize("point", [-5.0, -1.25, 0.0, 5.0])
def test_spline_is_continuous_at_its_knots(point: float) -> None:
    spline = spline_layer(16).build(torch.randn(49, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))
    knot = spline.x[..., int((point + 5) / 10 * 16)]
    near = knot + torch.tensor([-1e-9, 0.0, 1e-9], dtype=torch.float64)
    y, ladj = spline.forward(near)
    assert float((y[2] - y[0]).abs()) < 1e-6
    assert float((ladj[2] - ladj[0]).abs()) < 1e-5


def test_student_tail_turns_student_noise_nearly_normal() -> None:
    probability = [1e-6, 1e-3, 0.2]
    weight = torch.tensor(0.2, dtype=torch.float64)
    latent = StudentTail(weight, weight).forward(torch.from_numpy(stats.t(5).ppf(probability)))[0]
    assert torch.allclose(latent, torch.from_numpy(stats.norm.ppf(probability)), rtol=0.06)


@pytest.mark.parametrize("layer", [AFFINE, radial_layer(0.3), spline_layer(8)])
def test_maps_between_rows_have_parameters_in_between(layer: Layer) -> None:
    raw = torch.randn(5, len(layer.initial), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows, x = layer.build(raw), torch.linspace(-7, 7, 60, dtype=torch.float64).reshape(3, 20)
    row, weight = torch.tensor([[0], [2], [3]]), torch.tensor([[0.0], [0.3], [1.0]], dtype=torch.float64)
    found = rows.between_rows(row, weight)
    for i, (at, share) in enumerate(zip(row.flatten(), weight.flatten(), strict=True)):
        parts = (getattr(rows, each.name) for each in fields(rows) if each.name != "between")
        expected = type(rows)(*(torch.lerp(part[at], part[at + 1], share) for part in parts))
        for direction in ("forward", "inverse"):
            y, ladj = getattr(found, direction)(x)
            y_expected, ladj_expected = getattr(expected, direction)(x[i])
            assert torch.allclose(y[i], y_expected, rtol=1e-12, atol=1e-12)
            assert torch.allclose(ladj[i], ladj_expected, rtol=1e-10, atol=1e-10)


def test_a_spline_is_durkans_between_its_knots_and_straight_beyond_them() -> None:
    x = torch.tensor([-1.0, 0.0, 0.5, 2.0], dtype=torch.float64)
    y = torch.tensor([-3.0, -1.0, 0.0, 0.7], dtype=torch.float64)
    slope = torch.tensor([0.4, 3.0, 1.0, 2.5], dtype=torch.float64)
    spline = Spline(x, y, slope)
    for k in range(3):
        secant = (y[k + 1] - y[k]) / (x[k + 1] - x[k])
        for share in (0.0, 0.2, 0.7, 0.999):
            rest = share * (1 - share)
            below = secant + (slope[k + 1] + slope[k] - 2 * secant) * rest
            expected = y[k] + (y[k + 1] - y[k]) * (secant * share**2 + slope[k] * rest) / below
            derivative = (
                secant**2 * (slope[k + 1] * share**2 + 2 * secant * rest + slope[k] * (1 - share) ** 2) / below**2
            )
            at = x[k] + share * (x[k + 1] - x[k])
            found, ladj = spline.forward(at)
            assert torch.allclose(found, expected, rtol=1e-12)
            assert torch.allclose(ladj, derivative.log(), rtol=1e-10, atol=1e-12)
            back, ladj = spline.inverse(expected)
            assert torch.allclose(back, at, rtol=1e-10, atol=1e-10)
            assert torch.allclose(ladj, -derivative.log(), rtol=1e-8, atol=1e-8)
    for end, side in ((0, -1.0), (3, 1.0)):
        found, ladj = spline.forward(x[end] + side * 5)
        assert torch.allclose(found, y[end] + side * 5 * slope[end])
        assert torch.allclose(ladj, slope[end].log())
        back, ladj = spline.inverse(y[end] + side * 5)
        assert torch.allclose(back, x[end] + side * 5 / slope[end])
        assert torch.allclose(ladj, -slope[end].log())


@pytest.mark.parametrize(("left", "right"), [(0.3, 0.05), (0.0, 0.2), (1e-9, 0.0)])
def test_each_tail_is_that_of_its_formula_and_its_own_weight(left: float, right: float) -> None:
    tail = StudentTail(torch.tensor(left).double(), torch.tensor(right).double())
    for at in (-200.0, -2.0, -0.05, 0.0, 0.05, 2.0, 200.0):
        weight, x = (left if at < 0 else right), torch.tensor(at, dtype=torch.float64)
        y, ladj = tail.forward(x)
        expected = at if weight == 0 else math.copysign(math.sqrt(math.log1p(weight * at * at) / weight), at)
        assert float(y) == pytest.approx(expected, rel=1e-7)
        derivative = 1.0 if expected == 0 or weight == 0 else at / expected / (1 + weight * at * at)
        assert float(ladj) == pytest.approx(math.log(derivative), rel=1e-7, abs=1e-7)
        back, ladj_back = tail.inverse(y)
        assert float(back) == pytest.approx(at, rel=1e-10)
        assert float(ladj_back) == pytest.approx(-float(ladj), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("t", [1e-6, 9e-4, 1.1e-3, 0.5])
def test_ratios_near_zero_keep_all_their_digits(t: float) -> None:
    """Where the series ends and the quotient begins, both are exact to the last digits but three."""
    at = torch.tensor(t, dtype=torch.float64)
    assert float(_log1p_ratio(at)) == pytest.approx(float(mpmath.log1p(t) / t), rel=1e-12)
    assert float(_expm1_ratio(at)) == pytest.approx(float(mpmath.expm1(t) / t), rel=1e-12)


def test_far_tails_of_the_inverse_stay_finite() -> None:
    tail = StudentTail(torch.tensor(1.0).double(), torch.tensor(1.0).double())
    back, ladj = tail.inverse(torch.tensor([8.0, 100.0], dtype=torch.float64))
    assert float(back[0]) == pytest.approx(math.sqrt(math.expm1(64.0)), rel=1e-12)
    assert bool(torch.isfinite(back).all() & torch.isfinite(ladj).all())
    single = StudentTail(torch.tensor(1.0), torch.tensor(1.0)).inverse(torch.tensor([100.0]))
    assert all(bool(torch.isfinite(each).all()) for each in single)
