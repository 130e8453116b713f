"""Moments, entropy and quantiles of a law against closed forms, and of a rescaled law against the law of scaled draws."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import noiseflow
from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile

SCALE, SHIFT = 2.5, -0.75


def gaussian() -> NoiseDistribution:
    return noiseflow.Gaussian(0.1).double()(torch.tensor([0.25, 0.5], dtype=torch.float64))


def rescaled() -> NoiseDistribution:
    scale = torch.full((2,), SCALE, dtype=torch.float64)
    return gaussian().rescaled(scale, torch.full((2,), SHIFT, dtype=torch.float64))


def test_entropy_is_that_of_the_normal_law() -> None:
    expected = 0.5 * math.log(2 * math.pi * math.e) + math.log(0.1)
    assert_close(gaussian().entropy(), torch.full((2,), expected, dtype=torch.float64), atol=1e-6, rtol=0)
    assert_close(rescaled().entropy(), gaussian().entropy() + math.log(SCALE), atol=1e-6, rtol=0)


def test_expectations_of_a_rescaled_law_are_those_of_scaled_values() -> None:
    signal = gaussian().mean
    mean = SCALE * signal + SHIFT
    assert_close(rescaled().expectation(lambda o: o), mean, atol=1e-7, rtol=0)
    assert_close(rescaled().expectation(lambda o: torch.ones_like(o)), torch.ones_like(mean))
    spread = torch.full_like(mean, (SCALE * 0.1) ** 2)
    assert_close(rescaled().expectation(lambda o: (o - mean) ** 2), spread, atol=1e-7, rtol=0)
    assert_close(rescaled().mean, mean)
    assert_close(rescaled().variance, spread)


def test_probabilities_of_a_rescaled_law_are_those_of_the_interval_scaled_back() -> None:
    law, normal = rescaled(), torch.distributions.Normal(rescaled().mean, SCALE * 0.1)
    low, high = (normal.mean + step * normal.stddev for step in (-0.7, 1.1))
    between = normal.cdf(high) - normal.cdf(low)
    assert_close(law.log_interval_prob(low, high).exp(), between)
    assert_close(law.cdf(high), normal.cdf(high))
    assert_close(law.icdf(normal.cdf(high)), high)
    assert_close(law.log_prob(high), normal.log_prob(high))
    everything = torch.full_like(low, math.inf)
    assert_close(law.log_interval_prob(-everything, everything), torch.zeros_like(low))


def test_mode_is_where_the_density_is_greatest() -> None:
    assert_close(rescaled().mode, rescaled().mean, atol=2e-3, rtol=0)


@pytest.mark.parametrize("count", [1, 7])
def test_draws_of_a_rescaled_law_are_scaled_draws(count: int) -> None:
    drawn = rescaled().sample((count,), generator=torch.Generator().manual_seed(0))
    plain = gaussian().sample((count,), generator=torch.Generator().manual_seed(0))
    assert_close(drawn, plain * SCALE + SHIFT)


class Gumbel(NoiseDistribution):
    """A skewed law whose moments, entropy and mode are all different, and known; it writes only what it must."""

    def __init__(self, place: torch.Tensor, width: torch.Tensor) -> None:
        super().__init__(place.shape, like=place)
        self.place, self.width = place, width

    def _standard(self, value: torch.Tensor) -> torch.Tensor:
        return (value - self.place) / self.width

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        z = self._standard(value)
        return -z - torch.exp(-z) - torch.log(self.width)

    def cdf(self, value: torch.Tensor) -> torch.Tensor:
        return torch.exp(-torch.exp(-self._standard(value)))

    def log_interval_prob(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        return torch.log(self.cdf(high) - self.cdf(low))

    def icdf(self, value: torch.Tensor) -> torch.Tensor:
        return self.place - self.width * torch.log(-torch.log(value))

    def sample(self, sample_shape=(), generator=None) -> torch.Tensor:
        return self.icdf(torch.rand(*sample_shape, *self.batch_shape, generator=generator, dtype=self.dtype))


PLACE, WIDTH = torch.tensor([0.3, -40.0], dtype=torch.float64), torch.tensor([0.7, 11.0], dtype=torch.float64)
EULER = 0.57721566490153286


def test_what_a_law_does_not_write_itself_follows_from_density_and_quantiles() -> None:
    law = Gumbel(PLACE, WIDTH)
    # the quadrature leaves out tails of probability 1e-10, and with them about 1e-8 widths of the mean
    for found, expected, power in (
        (law.mean, PLACE + EULER * WIDTH, 1),
        (law.variance, math.pi**2 / 6 * WIDTH**2, 2),
        (law.entropy(), torch.log(WIDTH) + EULER + 1, 0),
    ):
        assert float(((found - expected) / WIDTH**power).abs().max()) < 1e-6
    assert float(((law.mode - PLACE) / WIDTH).abs().max()) < 1e-3
    assert_close(law.cdf_below(PLACE), torch.full((2,), math.exp(-1), dtype=torch.float64))
    assert all(torch.isinf(end) and (end > 0) == high for end, high in zip(law.limits, (False, True), strict=True))


def test_extreme_quantiles_are_found_once_for_all_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    law, asked, quantile = Gumbel(PLACE, WIDTH), [], Gumbel.icdf
    monkeypatch.setattr(Gumbel, "icdf", lambda self, value: asked.append(value) or quantile(self, value))
    moments = law.mean, law.variance, law.entropy()
    assert len(asked) == 2
    part = law.expand((3, 2))  # its own
    for found, expected in zip((part.mean, part.variance, part.entropy()), moments, strict=True):
        assert_close(found, expected.expand(3, 2))


def test_weights_between_two_bounds_are_those_of_what_lies_between_them() -> None:
    law = Gumbel(PLACE, WIDTH)
    low, high = PLACE - WIDTH, PLACE + WIDTH
    nodes, weights = law.panels(low, high, 40)
    assert nodes.shape == weights.shape == (160, 2)
    assert bool(((nodes > low) & (nodes < high)).all())
    assert_close(weights.sum(0), torch.ones_like(low))
    share = (weights * (nodes < PLACE)).sum(0)
    expected = (law.cdf(PLACE) - law.cdf(low)) / (law.cdf(high) - law.cdf(low))
    assert_close(share, expected)


def test_draws_move_with_place_and_width_as_their_quantile_does() -> None:
    place, width = PLACE.clone().requires_grad_(), WIDTH.clone().requires_grad_()
    law = Gumbel(place, width)
    drawn = law.rsample((5,), generator=torch.Generator().manual_seed(0))
    assert_close(drawn.detach(), law.sample((5,), generator=torch.Generator().manual_seed(0)).detach())
    by_place, by_width = torch.autograd.grad(drawn.sum(), (place, width))
    assert_close(by_place, torch.full_like(PLACE, 5.0))
    assert_close(by_width, ((drawn - PLACE) / WIDTH).sum(0).detach())
    law.has_rsample = False
    with pytest.raises(NotImplementedError, match="Gumbel: observations are discrete"):
        law.rsample()


def test_bisection_finds_the_quantile() -> None:
    law, share = Gumbel(PLACE, WIDTH), torch.tensor([0.02, 0.9], dtype=torch.float64)
    found = bisect_quantile(law.cdf, share, PLACE - 30 * WIDTH, PLACE + 30 * WIDTH)
    assert_close(found, law.icdf(share), rtol=1e-12, atol=1e-12)
    for below, above in ((1.0, 1e-9), (1e-9, 1.0)):  # as exact where the quantile lies close to an end of the bracket
        found = bisect_quantile(law.cdf, share, law.icdf(share) - below * WIDTH, law.icdf(share) + above * WIDTH)
        # the cumulated probability, of which it is the inverse, has 16 digits
        assert float(((found - law.icdf(share)) / WIDTH).abs().max()) < 1e-13


def test_a_rescaled_law_is_that_of_the_scaled_observation_in_every_respect() -> None:
    law = Gumbel(PLACE, WIDTH)
    scale = torch.tensor([[2.0, 0.5], [3.0, 0.1], [1.0, 7.0]], dtype=torch.float64)
    shift = torch.tensor([[5.0], [-3.0], [0.0]], dtype=torch.float64)
    found, expected = law.rescaled(scale, shift), Gumbel(scale * PLACE + shift, scale * WIDTH)
    assert found.batch_shape == (3, 2)
    value = expected.place + 0.4 * expected.width
    for each in (
        lambda one: one.log_prob(value),
        lambda one: one.cdf(value),
        lambda one: one.cdf_below(value),
        lambda one: one.icdf(torch.tensor([0.2, 0.6], dtype=torch.float64)),
        lambda one: one.log_interval_prob(value - 1, value + 2),
        lambda one: one.mean,
        lambda one: one.variance,
        lambda one: one.entropy(),
        lambda one: one.expand((4, 3, 2)).log_prob(value),
    ):
        assert_close(each(found), each(expected), rtol=1e-7, atol=1e-9)
    drawn, plain = (one.sample((7,), generator=torch.Generator().manual_seed(1)) for one in (found, law.expand((3, 2))))
    assert_close(drawn, plain * scale + shift)
    assert found.has_rsample
    assert not found.discrete
    assert found.independent


def test_an_infinite_bound_of_a_rescaled_law_leaves_the_gradients_of_the_other_finite() -> None:
    scale, shift = (torch.full((2,), value, dtype=torch.float64, requires_grad=True) for value in (2.0, 1.0))
    found = Gumbel(PLACE, WIDTH).rescaled(scale, shift)
    value = found.log_interval_prob(torch.full_like(PLACE, -math.inf), found.icdf(torch.full_like(PLACE, 0.3)).detach())
    assert_close(value.exp().detach(), torch.full_like(PLACE, 0.3))
    value.sum().backward()
    z = Gumbel(PLACE, WIDTH).icdf(torch.full_like(PLACE, 0.3))
    density = Gumbel(PLACE, WIDTH).log_prob(z).exp() / 0.3
    assert_close(shift.grad, -density / 2)
    assert_close(scale.grad, -density * z / 2)


def test_a_rescaled_converter_is_limited_where_its_limits_go() -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.3), 0.125, 0.0, 1.0).double()
    inner = model(PLACE.clamp(0, 1))
    found = inner.base.rescaled(torch.tensor(2.0).double(), torch.tensor(-1.0).double())
    assert all(torch.isinf(end) for end in found.limits)
    clipped = super(type(inner), inner).rescaled(torch.tensor([2.0, 4.0]).double(), torch.tensor([-1.0, 3.0]).double())
    assert_close(clipped.limits[0], torch.tensor([-1.0, 3.0], dtype=torch.float64))
    assert_close(clipped.limits[1], torch.tensor([1.0, 7.0], dtype=torch.float64))
    assert clipped.discrete
    assert not clipped.has_rsample


def test_draws_come_with_their_log_densities_and_deviations_without_graph() -> None:
    signal = torch.linspace(0.1, 0.9, 5, requires_grad=True)
    law = noiseflow.SplineFlow()(signal)
    drawn, log_prob = law.rsample_and_log_prob(3, generator=torch.Generator().manual_seed(0))
    assert drawn.shape == (3, 5)
    torch.testing.assert_close(log_prob, law.log_prob(drawn))
    assert torch.autograd.grad((drawn + log_prob).sum(), signal)[0].isfinite().all()
    assert not law.stddev.requires_grad
    torch.testing.assert_close(law.stddev, law.variance.sqrt().detach())


@pytest.mark.parametrize("shape", [3.0, "3", -1, (2, -1), None, [2.0]])
def test_a_shape_of_draws_that_is_none_is_refused(shape: object) -> None:
    with pytest.raises(ValueError, match="sample_shape"):
        noiseflow.Gaussian()(torch.zeros(5)).sample(shape)


class TwoPeaks(LatentDistribution):
    """A standard normal latent; what lies beyond a place of it is moved up by 20."""

    def __init__(self, place: torch.Tensor) -> None:
        super().__init__(place.shape)
        self.place = place

    def to_latent(self, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        beyond = (value - self.place) / (1 + 20 / JUMP)
        latent = torch.where(value < self.place, value, torch.where(beyond < JUMP, self.place + beyond, value - 20))
        return latent, -torch.log1p((latent > self.place) * (latent < self.place + JUMP) * 20 / JUMP)

    def from_latent(self, latent: torch.Tensor) -> torch.Tensor:
        return latent + 20 * ((latent - self.place) / JUMP).clamp(0, 1)


JUMP = 1e-6


def test_the_moments_of_two_peaks_are_exact_wherever_the_latent_jumps() -> None:
    place = torch.linspace(-3, 3, 41, dtype=torch.float64)
    share, density = 1 - torch.special.ndtr(place), torch.exp(-(place**2) / 2) / math.sqrt(2 * math.pi)
    law = TwoPeaks(place)
    assert torch.allclose(law.mean, 20 * share, rtol=0, atol=2e-4)
    assert torch.allclose(law.variance, 1 + 400 * share * (1 - share) + 40 * density, rtol=3e-4, atol=0)


def test_moments_and_entropy_in_pieces_have_the_gradients_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    signal, found = torch.linspace(0, 1, 23, dtype=torch.float64), []
    for together in (1 << 10, 5):
        monkeypatch.setattr("noiseflow.distributions.noise_distribution.TOGETHER", together)
        model = noiseflow.SplineFlow().double()
        law = model(signal)
        values = torch.stack([law.mean, law.variance, law.entropy()])
        values.sum().backward()
        slope = torch.func.grad(lambda signal, model=model: model(signal).mean.sum())(signal)
        found.append((values, model.bias.grad, slope))
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one, other, rtol=1e-12, atol=1e-14)
