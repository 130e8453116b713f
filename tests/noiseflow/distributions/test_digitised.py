"""Rounded and clipped observations against the plain sum over what is rounded to each level."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import noiseflow
from noiseflow.distributions.wrappers.digitised import DigitisedDistribution

WIDTH = 0.31
SIGNALS = torch.tensor([-0.2, 0.13, 0.5, 1.4], dtype=torch.float64)
CONVERTERS = {
    "rounded": (0.3, -math.inf, math.inf),
    "rounded and clipped": (0.25, 0.0, 1.0),
    "clipped below": (0.25, 0.1, math.inf),
    "clipped above, between two levels": (0.25, -math.inf, 0.9),
    "clipped on both sides, above between two levels": (0.25, 0.1, 1.0),
    "one level between the limits": (0.5, 0.0, 0.5),
}


def made(step: float, low: float, high: float) -> DigitisedDistribution:
    return noiseflow.Digitised(noiseflow.Gaussian(WIDTH).double(), step, low, high)(SIGNALS)


def by_hand(value: np.ndarray, step: float, low: float, high: float) -> np.ndarray:
    """Rounding to whole steps from the low limit, or from zero where there is none, then clipping."""
    origin = low if math.isfinite(low) else 0.0
    return np.clip(np.round((value - origin) / step) * step + origin, low, high)


def summed(converter: tuple[float, float, float], signal: float) -> dict[float, float]:
    """Mass of every level, from a very fine sum over what is rounded to it."""
    fine = np.linspace(-8, 8, 1_600_001)
    mass = np.diff(torch.special.ndtr(torch.from_numpy(fine)).numpy())
    levels = np.round(by_hand(signal + WIDTH * (fine[1:] + fine[:-1]) / 2, *converter), 9)
    found, index = np.unique(levels, return_inverse=True)
    return dict(zip(found.tolist(), np.bincount(index, mass).tolist(), strict=True))


@pytest.mark.parametrize("name", CONVERTERS)
def test_masses_and_their_sums_are_those_of_what_is_rounded_to_a_level(name: str) -> None:
    law = made(*CONVERTERS[name])
    for pixel, signal in enumerate(SIGNALS.tolist()):
        masses = summed(CONVERTERS[name], signal)
        levels = torch.tensor(list(masses), dtype=torch.float64)[:, None].expand(-1, 4)
        expected = torch.tensor(list(masses.values()), dtype=torch.float64)
        likely = expected > 1e-12

        def of(found: Tensor, pixel: int = pixel) -> Tensor:
            return found[:, pixel]

        close = {"rtol": 1e-4, "atol": 2e-5}  # of the fine sum, whose cells straddle the edges
        assert_close(of(law.log_prob(levels)).exp(), expected, **close)
        assert_close(of(law.cdf(levels)), expected.cumsum(0), **close)
        assert_close(of(law.cdf_below(levels)), expected.cumsum(0) - expected, **close)
        assert_close(of(law.cdf(levels + 0.01)), expected.cumsum(0), **close)
        assert_close(of(law.cdf_below(levels + 0.01)), expected.cumsum(0), **close)
        assert_close(of(law.cdf(levels - 0.01)), expected.cumsum(0) - expected, **close)
        pairs = law.log_interval_prob(levels[:-1], levels[1:]).exp()
        assert_close(of(pairs), expected[1:], **close)
        middle = (expected.cumsum(0) - expected / 2).clamp(0, 1)[:, None].expand(-1, 4)
        found = of(law.icdf(middle))
        assert_close(found[likely], levels[:, 0][likely])
        mean = float((expected * levels[:, 0]).sum())
        assert float(law.mean[pixel]) == pytest.approx(mean, abs=1e-5)
        assert float(law.variance[pixel]) == pytest.approx(
            float((expected * (levels[:, 0] - mean) ** 2).sum()), abs=1e-5
        )
        entropy = -float((expected[likely] * expected[likely].log()).sum())
        assert float(law.entropy()[pixel]) == pytest.approx(entropy, abs=1e-4)
        assert float(law.mode[pixel]) == pytest.approx(max(masses, key=masses.__getitem__))


@pytest.mark.parametrize("name", CONVERTERS)
def test_digitising_is_rounding_and_then_clipping(name: str) -> None:
    values = torch.linspace(-3, 3, 997, dtype=torch.float64)
    law = made(*CONVERTERS[name])
    np.testing.assert_allclose(law.digitise(values), by_hand(values.numpy(), *CONVERTERS[name]), atol=1e-12)
    drawn = law.sample((5,), generator=torch.Generator().manual_seed(0))
    plain = law.base.sample((5,), generator=torch.Generator().manual_seed(0))
    assert torch.equal(drawn, law.digitise(plain))
    assert bool(law.support.check(drawn).all())
    assert not bool(law.support.check(drawn + 0.05).any())
    _, low, high = CONVERTERS[name]
    assert [float(end) for end in law.limits] == [low, high]
    assert law.discrete
    assert not law.has_rsample


@pytest.mark.parametrize("name", CONVERTERS)
def test_edges_are_where_the_limits_begin(name: str) -> None:
    law = made(*CONVERTERS[name])
    _, low, high = CONVERTERS[name]
    below, above = law.edges
    for edge, limit, side in ((below, low, -1), (above, high, 1)):
        if math.isfinite(limit):
            near = torch.tensor([edge + side * 1e-6, edge - side * 1e-6], dtype=torch.float64)
            assert (law.digitise(near) == limit).tolist() == [True, False]
        else:
            assert edge == limit


@pytest.mark.parametrize("name", [name for name in CONVERTERS if CONVERTERS[name][1] > -1 or CONVERTERS[name][2] < 9])
def test_nothing_lies_beyond_a_limit_by_more_than_half_a_step(name: str) -> None:
    step, low, high = CONVERTERS[name]
    law = made(step, low, high)
    for limit, side in ((low, -1), (high, 1)):
        if math.isfinite(limit):
            at = law.log_prob(torch.full((4,), limit, dtype=torch.float64))
            assert_close(law.log_prob(torch.full((4,), limit + side * 0.49 * step, dtype=torch.float64)), at)
            assert torch.isneginf(law.log_prob(torch.full((4,), limit + side * 0.51 * step, dtype=torch.float64))).all()
            assert law.cdf(torch.full((4,), high, dtype=torch.float64)).tolist() == [1.0] * 4
            assert law.cdf_below(torch.full((4,), low, dtype=torch.float64)).tolist() == [0.0] * 4
            assert law.cdf(torch.full((4,), low - 0.2, dtype=torch.float64)).tolist() == [0.0] * 4
            assert law.cdf_below(torch.full((4,), high + 0.2, dtype=torch.float64)).tolist() == [1.0] * 4


def test_what_is_beyond_a_limit_by_half_a_step_is_on_it() -> None:
    law, half = made(0.25, 0.0, 1.0), 0.125
    for limit, beyond in ((0.0, -half), (1.0, half)):
        at, outside = (law.log_prob(torch.full((4,), value, dtype=torch.float64)) for value in (limit, limit + beyond))
        assert torch.equal(outside, at)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.0, math.inf), (-math.inf, 0.9)])
@pytest.mark.parametrize("shape", [(4,), (3, 4)])
def test_clipping_alone_keeps_the_density_between_the_limits(low: float, high: float, shape: tuple[int, ...]) -> None:
    law, normal = made(0.0, low, high), torch.distributions.Normal(SIGNALS, WIDTH)
    inside = torch.full(shape, 0.4, dtype=torch.float64)
    assert_close(law.log_prob(inside), normal.log_prob(inside))
    assert law.edges == (low, high)
    if math.isfinite(low):
        at = torch.full(shape, low, dtype=torch.float64)
        assert_close(law.log_prob(at).exp(), normal.cdf(at))
        assert torch.isneginf(law.log_prob(at - 1e-6)).all()
        assert_close(law.log_prob(at + 1e-6), normal.log_prob(at + 1e-6))
        assert_close(law.cdf(at), normal.cdf(at))
        assert law.cdf_below(at).abs().max() == 0
    if math.isfinite(high):
        at = torch.full(shape, high, dtype=torch.float64)
        assert_close(law.log_prob(at).exp(), 1 - normal.cdf(at))
        assert torch.isneginf(law.log_prob(at + 1e-6)).all()
        assert_close(law.cdf(at), torch.ones_like(at))
        assert_close(law.cdf_below(at), normal.cdf(at))
    assert not law.discrete
    assert law.has_rsample
    draws = law.rsample((50_000,), generator=torch.Generator().manual_seed(0))
    assert_close(law.mean, draws.mean(0), atol=5e-3, rtol=0)
    assert_close(law.variance, draws.var(0), atol=5e-3, rtol=0)
    assert bool(((draws >= low) & (draws <= high)).all())
    assert bool(law.support.check(draws).all())


def test_a_clipped_draw_moves_with_the_signal_unless_it_is_clipped() -> None:
    signal = SIGNALS.clone().requires_grad_()
    law = noiseflow.Digitised(noiseflow.Gaussian(WIDTH).double(), 0.0, 0.0, 1.0)(signal)
    drawn = law.rsample((30,), generator=torch.Generator().manual_seed(0))
    (slope,) = torch.autograd.grad(drawn.sum(), signal)
    assert_close(slope, ((drawn > 0) & (drawn < 1)).sum(0).double())


def test_single_precision_does_not_move_the_edges_of_cells() -> None:
    """Readings of a million by steps of a half: in single precision an edge between two would be off by a quarter step."""
    model = noiseflow.Digitised(noiseflow.Gaussian(0.8), 0.5)
    signal = torch.tensor([4_000_000.0, 8_000_000.5])
    for step in (-0.5, 0.0, 1.5):
        found = model(signal).log_prob(signal + step)
        exact = model.double()(signal.double()).log_prob(signal.double() + step)
        model.float()
        assert_close(found.double(), exact, atol=1e-4, rtol=0)
        assert found.dtype == torch.float32


@pytest.mark.parametrize("step", [0.0, 0.1])
def test_limits_that_single_precision_rounds_are_limits_still(step: float) -> None:
    signal = SIGNALS.float()
    law = noiseflow.Digitised(noiseflow.Gaussian(WIDTH), step, 0.1, 0.7)(signal)
    normal = torch.distributions.Normal(signal, WIDTH)
    below, above = normal.cdf(torch.tensor(0.1 + step / 2)), 1 - normal.cdf(torch.tensor(0.7 - step / 2))
    for limit, mass in ((0.1, below), (0.7, above)):
        for nudge in (0.0, 1e-8 if limit == 0.1 else -1e-8):
            reading = torch.full((4,), limit + nudge, dtype=torch.float32)
            assert_close(law.log_prob(reading).exp(), mass, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("step", [0.0, 0.1])
@pytest.mark.parametrize(("given", "own"), [(torch.float32, torch.float64), (torch.float16, torch.float32)])
def test_a_limit_of_a_narrower_number_type_is_the_limit(step: float, given: torch.dtype, own: torch.dtype) -> None:
    """Files hold single precision, in which 0.1 is above the 0.1 of a model in double precision and 0.9 below its 0.9."""
    law = noiseflow.Digitised(noiseflow.Gaussian(WIDTH), step, 0.1, 0.9).to(own)(SIGNALS.to(own))
    for limit in (0.1, 0.9):
        narrow, wide = (torch.full((4,), limit, dtype=kind) for kind in (given, own))
        assert torch.equal(law.log_prob(narrow), law.log_prob(wide))
        assert torch.equal(law.cdf(narrow), law.cdf(wide))
        assert torch.equal(law.cdf_below(narrow), law.cdf_below(wide))
    between = torch.full((4,), 0.5, dtype=given)
    assert torch.equal(law.log_prob(between), law.log_prob(between.to(own)))


@pytest.mark.parametrize("masked", [False, True])
def test_a_limit_in_an_array_of_single_precision_is_the_limit(masked: bool) -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(WIDTH), 0.0, 0.1, 0.9).double()
    reading = np.array([0.1, 0.9, 0.5, 0.3])
    law = model(np.array([0.2, 0.8, 0.5, 0.5]))
    narrow = np.ma.masked_equal(reading, 0.3).astype(np.float32) if masked else reading.astype(np.float32)
    np.testing.assert_allclose(law.log_prob(narrow)[:3], law.log_prob(reading)[:3], rtol=1e-5)


def test_a_limit_of_single_precision_is_the_limit_beneath_offsets_of_rows() -> None:
    model = noiseflow.ScanNoise(noiseflow.Digitised(noiseflow.Gaussian(WIDTH), 0.0, 0.1, 0.9)).double()
    reading = torch.tensor([[0.1, 0.9, 0.4, 0.5]], dtype=torch.float64)
    law = model(torch.full((1, 4), 0.5, dtype=torch.float64))
    assert_close(law.log_prob(reading.float()), law.log_prob(reading), rtol=1e-5, atol=1e-5)


def test_levels_by_the_hundred_thousand_are_refused_where_they_would_be_added_up() -> None:
    law = noiseflow.Digitised(noiseflow.Gaussian(1.0).double(), 1e-4)(SIGNALS)
    with pytest.raises(ValueError, match="likely levels"):
        law.quadrature()
    most, wide = 65536, noiseflow.Gaussian(1e9).double()  # the noise reaches every level
    nodes, weights = noiseflow.Digitised(wide, 1.0, 0.0, most - 1.0)(SIGNALS[:1]).quadrature()
    assert len(nodes) == most
    assert (float(nodes[0]), float(nodes[-1])) == (0.0, most - 1.0)
    assert_close(weights.sum(0), torch.ones(1, dtype=torch.float64), atol=1e-12, rtol=0)
    with pytest.raises(ValueError, match=f"{most + 1} likely levels, more than {most}"):
        noiseflow.Digitised(wide, 1.0, 0.0, float(most))(SIGNALS[:1]).quadrature()
    few = noiseflow.Digitised(noiseflow.Gaussian(1.0).double(), 1e-3)(SIGNALS[:1])
    nodes, weights = few.quadrature()
    assert_close(weights.sum(0), torch.ones(1, dtype=torch.float64), atol=1e-12, rtol=0)
    assert float(nodes.min()) == pytest.approx(-0.2 - 7.35, abs=0.02)  # quantiles of 1e-13


def test_moments_of_any_number_of_levels() -> None:
    """Narrow and wide noise in one batch: the narrow one sees the rounding, the wide one has more levels than can be added up."""
    law = noiseflow.Digitised(noiseflow.Poisson(1.0), 1.0, 0.0, 1e12)(
        torch.tensor([0.5, 2.0, 1e8], dtype=torch.float64)
    )
    assert_close(law.mean, torch.tensor([0.5, 2.0, 1e8], dtype=torch.float64), rtol=1e-6, atol=0)
    assert_close(law.variance, torch.tensor([0.5, 2.0, 1e8], dtype=torch.float64), rtol=1e-3, atol=0)
    halves = noiseflow.Digitised(noiseflow.Gaussian(1.0).double(), 1e-4, 0.0)(SIGNALS[:1] * 0)
    assert_close(halves.mean, torch.full_like(halves.mean, (2 * math.pi) ** -0.5), rtol=1e-3, atol=0)


@pytest.mark.parametrize(("low", "high"), [(0.0, 60000.0), (-math.inf, math.inf), (0.0, 900.0)])
def test_moments_of_heavy_tails_take_few_groups_of_levels(low: float, high: float) -> None:
    signal = torch.linspace(300, 800, 9, dtype=torch.float64)
    torch.manual_seed(0)
    tails = torch.distributions.StudentT(torch.full((9,), 3.0, dtype=torch.float64)).sample((4000,))
    heavy = noiseflow.Mixture(3)
    heavy.scale_to(signal.expand(4000, 9).float().reshape(-1), (signal + 100 * tails).float().reshape(-1))
    law = noiseflow.Digitised(heavy, 1.0, low, high)(signal)
    nodes, weights = law.quadrature()
    mean = (weights * nodes).sum(0) / weights.sum(0)
    variance = (weights * (nodes - mean) ** 2).sum(0) / weights.sum(0)
    assert_close(law.variance, variance, rtol=3e-4, atol=0)
    assert float(((law.mean - mean) / variance.sqrt()).abs().max()) < 1e-4
    used: list[int] = []
    law.expectation(lambda value: used.append(len(value)) or value)  # type: ignore[func-returns-value]
    assert used[0] < 900 < len(nodes)


def test_a_rescaled_converter_digitises_what_is_rescaled() -> None:
    law = made(0.25, 0.0, 1.0)
    found = law.rescaled(torch.tensor(2.0).double(), torch.tensor(0.1).double())
    expected = DigitisedDistribution(
        noiseflow.Digitised(noiseflow.Gaussian(1.0), 0.25, 0.0, 1.0),
        torch.distributions.Normal(2 * SIGNALS + 0.1, 2 * WIDTH),
    )
    levels = (torch.arange(5, dtype=torch.float64) / 4)[:, None].expand(-1, 4)
    assert_close(found.log_prob(levels), expected.log_prob(levels))


def test_only_a_module_and_its_signal_may_be_looked_up_in_tables() -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(WIDTH).double(), 0.25, 0.0, 1.0)
    assert model(SIGNALS).source == (model, SIGNALS)
    assert DigitisedDistribution(model, model(SIGNALS).base).source is None

    class Plain:
        step, low, high = 0.25, 0.0, 1.0

    assert DigitisedDistribution(Plain(), model(SIGNALS).base, SIGNALS).source is None


COUNTERS = {
    "odd counts on the edges of levels": (lambda: noiseflow.Poisson(1.0), 2.0, -math.inf, math.inf),
    "with a gain that no number holds exactly": (lambda: noiseflow.Poisson(0.1, 0.3), 0.2, -math.inf, math.inf),
    "clipped at a level that no number holds exactly": (lambda: noiseflow.Poisson(1.0), 1 / 3, 2 / 3, 3.0),
    "an edge near a count": (lambda: noiseflow.DeadTimeCounter(3e-4), 35 / 21.50018, -math.inf, math.inf),
    "far from zero": (lambda: noiseflow.Poisson(1e-3, 100.0), 3e-4, 100.0006, 100.0027),
}


@pytest.mark.parametrize("precision", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", COUNTERS)
def test_draws_of_counts_have_the_probability_of_their_level(name: str, precision: torch.dtype) -> None:
    make, *converter = COUNTERS[name]
    model = noiseflow.Digitised(make(), *converter).double()
    unit = {"with a gain that no number holds exactly": (0.1, 0.3), "far from zero": (1e-3, 100.0)}.get(
        name, (1.0, 0.0)
    )
    signal = unit[1] + unit[0] * torch.tensor([0.5, 6.0, 30.0], dtype=torch.float64)
    draws = model(signal).sample((40_000,), generator=torch.Generator().manual_seed(3))
    law = model.to(precision)(signal.to(precision))
    for pixel in range(3):
        levels, times = draws[:, pixel].unique(return_counts=True)
        assert len(levels) == 1 or float(levels.diff().min()) > 0.5 * converter[0], "one level has two values"
        mass = law.log_prob(levels[:, None].to(precision).expand(-1, 3))[:, pixel].detach().exp().double()
        assert float(mass.sum()) == pytest.approx(1, abs=2e-3)
        assert bool(((times / len(draws) - mass).abs() < 5 * torch.sqrt(mass / len(draws)) + 1e-4).all())
