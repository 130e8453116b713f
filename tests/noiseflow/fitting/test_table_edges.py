"""The likelihood table beyond its rows, and its promise of accuracy."""

from __future__ import annotations

import math

import pytest
import torch

import noiseflow
from noiseflow.distributions.numerics.tables import SIZES
from noiseflow.fitting.observation_table import ObservationTable, TableKeeper


@pytest.fixture(scope="module")
def table() -> tuple[torch.nn.Module, torch.Tensor, ObservationTable]:
    model = noiseflow.Gaussian(0.1)
    signal = torch.rand(4000, generator=torch.Generator().manual_seed(0))
    noisy = signal + 0.1 * torch.randn(4000, generator=torch.Generator().manual_seed(1))
    return model, noisy, ObservationTable(model, noisy, 0.0, 1.0)


def exact(model: torch.nn.Module, signal: torch.Tensor, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    signal = signal.clone().requires_grad_()
    value = model(signal).log_prob(observation)
    (slope,) = torch.autograd.grad(value.sum(), signal)
    return value.detach(), slope


@pytest.mark.parametrize(("edge", "beyond"), [(1.0, 0.3), (0.0, -0.2)])
def test_beyond_its_rows_the_likelihood_goes_on_along_its_slope(table, edge: float, beyond: float) -> None:
    model, observation, found = table
    near = (observation - edge).abs() < 0.3
    value, slope = exact(model, torch.full_like(observation, edge), observation)
    outside = found.log_prob(torch.full_like(observation, edge + beyond))
    expected = value + beyond * slope
    scale = float((beyond * slope)[near].abs().mean())
    assert float((outside - expected)[near].abs().mean()) < 0.05 * scale
    steep = found.slope(torch.full_like(observation, edge + beyond))
    assert float((steep - slope)[near].abs().mean()) < 0.05 * float(slope[near].abs().mean())


def test_within_its_rows_value_and_slope_are_those_of_the_model(table) -> None:
    model, observation, found = table
    signal = (observation + 0.05).clamp(0.02, 0.98)
    value, slope = exact(model, signal, observation)
    assert found.error <= 1e-3
    assert float((found.log_prob(signal) - value).abs().mean()) < 2e-3
    assert float((found.slope(signal) - slope).abs().mean()) < 0.02 * float(slope.abs().mean())


class Wavy(torch.nn.Module):
    """Normal noise whose log-density ripples along the residual, from some size of it on; finer ripples need finer tables."""

    def __init__(self, waves: float, beyond: float = 0.0) -> None:
        super().__init__()
        self.waves, self.beyond = torch.nn.Parameter(torch.tensor(waves)), beyond

    def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:
        waves, beyond = self.waves, self.beyond

        class Law(torch.distributions.Normal):
            def log_prob(self, value: torch.Tensor) -> torch.Tensor:
                residual = value - self.loc
                return super().log_prob(value) + 0.2 * torch.sin(waves * residual) * (residual.abs() > beyond)

        return Law(signal, torch.full_like(signal, 0.1), validate_args=False)


def spread(count: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(count, generator=generator) + 0.1 * torch.randn(count, generator=generator)


def error_of(found: ObservationTable, model: torch.nn.Module, observation: torch.Tensor) -> float:
    """Mean absolute error at signals that the observations make likely, far more of them than the table judges itself by."""
    errors = []
    for seed in range(20):
        noise = 0.1 * torch.randn(observation.shape, generator=torch.Generator().manual_seed(seed))
        signal = (observation - noise).clamp(found.low, found.high)
        errors.append((found.log_prob(signal) - model(signal).log_prob(observation)).abs().mean())
    return float(torch.stack(errors).mean().detach())


@pytest.mark.parametrize("waves", [0.0, 150.0, 1000.0])
def test_the_error_told_is_the_error_made(waves: float) -> None:
    model, observation = Wavy(waves), spread()
    found = ObservationTable(model, observation, 0.0, 1.0)
    assert error_of(found, model, observation) == pytest.approx(found.error, rel=0.25, abs=1e-5)
    assert found.measure_error(model) == found.error


def test_the_error_told_counts_unlikely_signals_as_often_as_they_are_met() -> None:
    model, observation = Wavy(3e4, beyond=0.2), spread()  # one residual of 22 lies beyond two standard deviations
    found = ObservationTable(model, observation, 0.0, 1.0)
    assert error_of(found, model, observation) == pytest.approx(found.error, rel=0.5)


def test_finer_columns_are_taken_where_they_are_needed_and_help() -> None:
    observation = spread()
    tables = {waves: ObservationTable(Wavy(waves), observation, 0.0, 1.0) for waves in (0.0, 150.0, 600.0)}
    sizes = [table.state()["size"] for table in tables.values()]
    assert sizes[0] < sizes[1] < sizes[2]
    assert all(table.error <= 1e-3 for table in tables.values())
    # what no size resolves gets the size with the least error, and says so
    hopeless = ObservationTable(Wavy(3e4), observation, 0.0, 1.0)
    assert hopeless.error > 0.02
    assert error_of(hopeless, Wavy(3e4), observation) == pytest.approx(hopeless.error, rel=0.25)


def test_a_model_that_outgrows_its_table_gets_a_finer_one_when_checked() -> None:
    model, observation = Wavy(0.0), spread()
    found = ObservationTable(model, observation, 0.0, 1.0)
    before = found.state()["size"]
    found.check(model)
    assert found.state()["size"] == before
    with torch.no_grad():
        model.waves.fill_(400.0)
    found.rebuild(model)
    assert found.check(model) <= 1e-3
    assert found.state()["size"] > before
    assert error_of(found, model, observation) < 1.5e-3


def test_rows_grow_where_signals_leave_them_and_not_for_a_few_strays() -> None:
    model, observation = noiseflow.Gaussian(0.1), spread()
    found = ObservationTable(model, observation, 0.0, 1.0)
    laid_out_for = found.state()["laid_out_for"]
    strays = torch.cat([torch.linspace(0.1, 0.9, 4000), torch.tensor([5.0, -5.0, 6.0])])
    found.cover(model, strays)
    assert (found.low, found.high) == (0.0, 1.0)
    found.cover(model, torch.full((100,), math.nan))
    assert (found.low, found.high) == (0.0, 1.0)
    found.cover(model, torch.linspace(0.0, 1.0, 4000).repeat(2))  # many signals on the outermost rows are within them
    assert found.state()["laid_out_for"] is laid_out_for
    found.cover(model, torch.cat([torch.zeros(10), torch.linspace(0.0, 1.5, 1000)]))
    assert found.low == 0.0  # many signals on the first row are not below it
    assert found.high == pytest.approx(1.5 + 0.2 * 1.5, rel=2e-3)  # a fifth beyond, so that it need not grow again soon
    high = found.high
    found.cover(model, torch.linspace(-0.4, 1.0, 1000))
    # as far again below as the signals went, and a hundredth: weak signals need the resolution
    assert found.low == pytest.approx(-0.8 - 0.01 * 1.8, rel=4e-3)
    assert found.high == high
    before = found.low
    found.cover(model, torch.linspace(-1.2, 1.0, 1000))
    assert found.low == pytest.approx(-2.4 - before - 0.01 * (high - before), rel=4e-3)
    assert error_of(found, model, observation) <= 1e-3
    below = torch.full_like(observation, -0.6)
    value, slope = exact(model, below, observation)
    near = observation < -0.05
    assert float((found.log_prob(below) - value)[near].abs().mean()) < 5e-3
    assert float((found.slope(below) - slope)[near].abs().mean()) < 0.02 * float(slope[near].abs().mean())


def test_rows_grow_by_a_share_of_the_signals_where_these_are_all_above() -> None:
    found = ObservationTable(noiseflow.Gaussian(0.1), spread(), 0.0, 1.0)
    found.cover(noiseflow.Gaussian(0.1), torch.linspace(2.0, 5.0, 1000))
    assert (found.low, found.high) == (0.0, pytest.approx(5.0 + 0.2 * 3.0, rel=2e-3))


@pytest.mark.parametrize("kind", ["counts", "continuous"])
def test_a_resumed_table_is_the_same_to_the_last_bit(kind: str) -> None:
    model: torch.nn.Module
    if kind == "counts":
        model, observation = noiseflow.Poisson(0.25, 0.0), (4 * spread().abs()).round() / 4
    else:
        model, observation = Wavy(150.0), spread()
    first = ObservationTable(model, observation, 0.05, 1.0)
    first.cover(model, torch.linspace(0.05, 1.4, 1000))
    state = first.state()
    if kind == "continuous":
        with torch.no_grad():
            model.waves.fill_(140.0)
    first.rebuild(model)
    again = ObservationTable(model, observation, 7.0, 8.0, resume=state)
    signal = torch.linspace(-0.1, 1.5, observation.numel())
    assert torch.equal(again.log_prob(signal), first.log_prob(signal))
    assert torch.equal(again.slope(signal), first.slope(signal))
    assert again.state().keys() == state.keys()
    assert (again.state()["low"], again.state()["high"], again.state()["size"]) == tuple(
        state[name] for name in ("low", "high", "size")
    )
    assert again.error == first.measure_error(model)


def test_few_levels_are_columns_so_that_nothing_is_interpolated_along_them() -> None:
    """Masses of single counts: between two of them there is nothing to interpolate to."""
    model = noiseflow.Digitised(noiseflow.Gaussian(0.02), step=0.25)
    observation = (4 * spread()).round() / 4
    found = ObservationTable(model, observation, 0.0, 1.0)
    value, _ = exact(model, torch.full_like(observation, 0.5), observation)
    possible = value > -30
    assert 0 < int(possible.sum()) < observation.numel()
    assert float((found.log_prob(torch.full_like(observation, 0.5)) - value)[possible].abs().max()) < 0.02
    assert found.error <= 1e-3
    assert found._step == 0


@pytest.mark.parametrize("waves", [150.0, 600.0])
def test_levels_that_serve_badly_as_columns_make_way_for_residuals(waves: float) -> None:
    """Ripples along the residual: rows would have to be as fine as they are."""
    model, observation = Wavy(waves), (256 * spread()).round() / 256
    found = ObservationTable(model, observation, 0.0, 1.0)
    assert found._step > 0
    assert found.error <= 1e-3
    assert error_of(found, model, observation) < 1.5e-3
    # no finer than for observations between the levels
    assert found.state()["size"] == len(SIZES) + ObservationTable(model, spread(), 0.0, 1.0).state()["size"]


def test_the_finest_table_is_not_made_again_where_it_is_not_fine_enough() -> None:
    model, observation = Wavy(1200.0), spread()
    found = ObservationTable(model, observation, 0.0, 1.0)
    state = found.state()
    assert state["size"] == len(SIZES) - 1
    assert found.check(model) > 1e-3
    assert found.state()["laid_out_for"] is state["laid_out_for"]


def test_a_single_level_and_a_single_signal_have_a_table() -> None:
    model = noiseflow.Gaussian(0.1)
    observation = torch.full((500,), 0.3)
    found = ObservationTable(model, observation, 0.0, 1.0)
    value, slope = exact(model, torch.full_like(observation, 0.42), observation)
    assert float((found.log_prob(torch.full_like(observation, 0.42)) - value).abs().max()) < 2e-3
    assert float((found.slope(torch.full_like(observation, 0.42)) - slope).abs().max()) < 0.02 * float(
        slope.abs().max()
    )
    assert found._step == 0
    narrow = ObservationTable(model, observation, 0.5, 0.5)
    assert narrow.high > narrow.low
    assert narrow.high - narrow.low < 1e-5
    distant = ObservationTable(model, observation - 1000, -1000.0, -1000.0)
    assert torch.tensor(distant.high) > torch.tensor(distant.low)  # in single precision


def test_two_levels_are_told_apart() -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.3), 1.0, 0.0, 1.0)
    observation = (spread() > 0.5).float()
    found = ObservationTable(model, observation, 0.0, 1.0)
    value, slope = exact(model, torch.full_like(observation, 0.3), observation)
    assert found._step == 0
    assert float((found.log_prob(torch.full_like(observation, 0.3)) - value).abs().max()) < 2e-3
    assert float((found.slope(torch.full_like(observation, 0.3)) - slope).abs().max()) < 0.05


class Partly(Wavy):
    """Such noise whose likelihood cannot be computed for the weakest signals."""

    def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:
        law = super().forward(signal)
        log_prob = law.log_prob
        law.log_prob = lambda value: torch.where(signal < 0.1, math.nan, log_prob(value))  # type: ignore[method-assign]
        return law


def test_signals_whose_likelihood_cannot_be_computed_do_not_count_for_the_error() -> None:
    observation = 0.7 + 0.05 * spread()
    assert ObservationTable(Partly(0.0), observation, 0.0, 1.0).error < 1e-2
    # nor do they hide how far the table is off at all others
    assert ObservationTable(Partly(3e4), observation, 0.0, 1.0).error > 0.02


def test_some_pixels_are_looked_up_as_all_of_them() -> None:
    model, observation = Wavy(150.0), spread()
    found = ObservationTable(model, observation, 0.0, 1.0)
    signal = torch.rand(observation.shape, generator=torch.Generator().manual_seed(5))
    whole, some = found.log_prob(signal), torch.tensor([3, 77, 3000])
    assert torch.equal(found.log_prob(signal[some], some), whole[some])
    assert torch.equal(found.log_prob(signal[100:200], slice(100, 200)), whole[100:200])


def test_a_keeper_makes_its_table_once_and_that_of_an_interrupted_fit_from_its_state() -> None:
    model, observation, made = noiseflow.Gaussian(0.1), spread(), []

    def make(resume: dict[str, object] | None) -> ObservationTable:
        made.append(resume)
        return ObservationTable(model, observation, 0.0, 1.0, resume=resume)

    keeper = TableKeeper()
    first = keeper.get(make)
    low, high = first.low, first.high
    first.cover(model, torch.tensor([0.0, 3.0]))
    assert first.high > high
    keeper.resume = state = first.state()
    interrupted, other = keeper.get(make), keeper.get(make)
    assert (interrupted.low, interrupted.high) == (first.low, first.high)
    assert (other.low, other.high) == (low, high)
    assert made == [None, state]
    assert keeper.resume is None
