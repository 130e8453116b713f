"""The plan as data: what will be done for six kinds of series, and that what is done is what was planned."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import noiseflow
from noiseflow.fitting.steps import WeightChoice
from recon.joint.joint import JointReconstructor
from recon.joint.plan import Facts, FitStage, Schedule, describe, plan, total_steps
from recon.joint.run import run_fit
from recon.methods import reconstruct
from recon.series.holdout import Holdout
from recon.series.tilt_series import TiltSeries
from recon.simulate.noises import SkewedNoise
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

pytestmark = pytest.mark.usefixtures("one_thread")

PLANS = {
    "everything chosen, small": (
        Facts(),
        """
        slab   start noise                  noise       10  simple
        slab   settle                       signal      40  simple, rate 1, remembered
        slab   choose noise                 candidates  20 x 2  chosen
        slab   adapt                        finalists   20  chosen, rate 0.6, warm-up
        slab   refine noise                 noise       20  chosen
        slab   choose weight                weights     50 x 4  chosen, rate 0.6
        slab   refine noise at the weight   noise       20  chosen
        whole  start noise of the volume    noise       10  simple
        whole  begin                        signal      25  simple, rate 0.6
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "clipped, large": (
        Facts(clipped=True, halvings=1),
        """
        slab   start with one width         noise       10  even
        slab   settle with one width        signal      20  even, rate 1
        slab   start noise                  noise       10  simple
        slab   settle                       signal      20  simple, rate 0.6, remembered
        slab   choose noise                 candidates  20 x 2  chosen
        slab   adapt                        finalists   20  chosen, rate 0.6, warm-up
        slab   refine noise                 noise       20  chosen
        slab   choose weight                weights     50 x 4  chosen, rate 0.6
        slab   refine noise at the weight   noise       20  chosen
        whole  start noise of the volume    noise       10  even
        whole  begin with one width         signal      13  even, rate 0.6, half the resolution
        whole  noise of the volume          noise       10  simple
        whole  begin                        signal      12  simple, rate 0.6, half the resolution
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "a block of a settled, clipped series": (
        Facts(settled=True, clipped=True),
        """
        whole  begin with one width         signal      13  even, rate 0.6
        whole  begin                        signal      12  simple, rate 0.6
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "least squares, weight given": (
        Facts(choose_noise=False, simple_is_final=True, choose_weight=False),
        """
        slab   start noise                  noise       10  simple
        slab   settle                       signal      40  simple, rate 1
        slab   learn noise                  noise       20  simple
        slab   adapt                        signal      20  simple, rate 0.6, warm-up
        slab   refine noise                 noise       20  simple
        whole  begin                        signal      25  simple, rate 0.6
        whole  fit                          signal      75  simple, rate 0.6
        """,
    ),
    "everything chosen, large": (
        Facts(halvings=1),
        """
        slab   start noise                  noise       10  simple
        slab   settle                       signal      40  simple, rate 1, remembered
        slab   choose noise                 candidates  20 x 2  chosen
        slab   adapt                        finalists   20  chosen, rate 0.6, warm-up
        slab   refine noise                 noise       20  chosen
        slab   choose weight                weights     50 x 4  chosen, rate 0.6
        slab   refine noise at the weight   noise       20  chosen
        whole  start noise of the volume    noise       10  simple
        whole  begin                        signal      25  simple, rate 0.6, half the resolution
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "wide": (
        Facts(choose_noise=False, learn_noise=False, choose_weight=False, halvings=2),
        """
        whole  start noise of the volume    noise       10  simple
        whole  begin                        signal      50  simple, rate 0.6, a quarter of the resolution
        whole  go on                        signal      150  chosen, rate 0.6, a quarter of the resolution
        whole  go on at half                signal      100  chosen, rate 0.6, half the resolution
        whole  fit                          signal      50  chosen, rate 0.6
        """,
    ),
    "noise known, weight given": (
        Facts(choose_noise=False, learn_noise=False, choose_weight=False, halvings=1),
        """
        whole  start noise of the volume    noise       10  simple
        whole  begin                        signal      25  simple, rate 0.6, half the resolution
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "a block of a settled series": (
        Facts(settled=True),
        """
        whole  begin                        signal      25  simple, rate 0.6
        whole  fit                          signal      75  chosen, rate 0.6
        """,
    ),
    "quiet": (
        Facts(choose_noise=False, simple_is_final=True, quiet=True, by_gaps=True, halvings=1),
        """
        slab   start noise                  noise       10  simple
        slab   settle                       signal      40  simple, rate 1, remembered
        slab   learn noise                  noise       20  simple
        slab   adapt                        signal      20  simple, rate 0.6, warm-up
        slab   refine noise                 noise       20  simple
        slab   choose weight                weights     120 x 4  simple, rate 0.6
        slab   refine noise at the weight   noise       20  simple
        whole  begin                        signal      40  simple, rate 0.6, half the resolution
        whole  fit                          signal      120  simple, rate 0.6
        whole  describe noise               noise       600  chosen
        """,
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_plan_is_the_stored_one(name):
    facts, stored = PLANS[name]
    expected = [line.strip() for line in stored.strip().splitlines()]
    assert [line.strip() for line in describe(plan(facts)).splitlines()] == expected


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("num_steps", [1, 2, 3, 7, 100, 333])
def test_the_volume_takes_as_many_steps_as_were_asked_for(name, num_steps):
    facts, _ = PLANS[name]
    stages = plan(facts, num_steps=num_steps)
    assert sum(s.num_steps for s in stages if s.kind == "signal" and s.where == "whole") == num_steps
    assert len({s.name for s in stages}) == len(stages)
    assert all(s.num_steps > 0 for s in stages)


def test_a_schedule_changes_what_it_names():
    facts = PLANS["everything chosen, small"][0]
    changed = plan(facts, schedule=replace(Schedule(), settle=7))
    assert [s.num_steps for s in changed if s.name == "settle"] == [7]
    assert [s for s in changed if s.name != "settle"] == [s for s in plan(facts) if s.name != "settle"]


def test_usual_steps_of_a_field_may_begin_at_a_quarter_of_the_resolution_and_steps_asked_for_do_not():
    facts = PLANS["wide"][0]
    usual, asked = (
        [(s.num_steps, s.halvings) for s in plan(facts, **{name: 450}) if s.kind == "signal"]
        for name in ("usual", "num_steps")
    )
    assert usual == [(224, 2), (672, 2), (448, 1), (226, 0)]
    assert asked == [(112, 1), (338, 0)]


@pytest.fixture(scope="module")
def clipped():
    clean, _ = clean_tilt_series(
        make_phantom("shells", 20, generator=np.random.default_rng(1), count=6), np.arange(-60, 61, 12.0)
    )
    return add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)


@pytest.mark.parametrize(
    "options",
    [{"num_steps": 9}, {"num_steps": 9, "slab": 4, "weight": 0.3}, {"num_steps": 5, "noise_model": SkewedNoise}],
    ids=["small", "slab, weight given", "noise known"],
)
def test_what_is_done_is_what_was_planned(clipped, options):
    done = []

    def run_fit(name, noise_model, signal, observation, **given):
        result = noiseflow.fit(noise_model, signal, observation, **given)
        if not isinstance(signal, noiseflow.KnownSignal):
            done.append((name, result.num_steps))
        return result

    fit = JointReconstructor(run_fit=run_fit, **options)
    planned, *_ = fit.plan(clipped)
    fit(clipped)
    signal = [(s.name, s.num_steps) for s in planned if s.kind in ("signal", "finalists")]
    assert [step for step in done if not step[0].startswith("adapt ") and "choose weight" not in step[0]] == signal
    assert any("choose weight" in name for name, _ in done) == any(s.kind == "weights" for s in planned)


def smooth(height, width):
    """A series without noise."""
    ramp = np.linspace(0, 1, height, dtype=np.float32)[:, None] + np.linspace(0, 1, width, dtype=np.float32)
    return TiltSeries(ramp * np.ones((9, 1, 1), np.float32), np.arange(9) * 10.0, mode="linear")


def test_little_noise_is_seen_before_any_fit(clipped):
    fit = JointReconstructor()
    assert "describe noise" in [s.name for s in fit.plan(smooth(20, 20))[0]]
    assert "choose noise" in [s.name for s in fit.plan(clipped)[0]]


def test_long_trials_of_weights_begin_where_quiet_series_end_on_no_more_slices_than_they_need():
    started = []

    def run_fit(name, *parts, **given):
        started.append(name)
        return noiseflow.fit(*parts, **given)

    short = replace(Schedule(), settle=1, adapt=1, quiet=2, describe=1)
    JointReconstructor(run_fit=run_fit, schedule=short)(smooth(20, 20))
    assert next(name for name in started if "choose weight" in name) == "choose weight 6.4"
    assert JointReconstructor().plan(smooth(32, 160))[1] == 16


@pytest.mark.parametrize(("noise", "held"), [(0.0, True), (1.0, False)])
def test_the_offset_is_held_where_a_linear_series_is_quiet(noise, held):
    fitted = []

    def run_fit(name, noise_model, signal, observation, **given):
        if not isinstance(signal, noiseflow.KnownSignal):
            offset = signal.image_formation.scaled_offset
            fitted.append(any(each is offset for group in given["parameter_groups"] for each in group["params"]))
        return noiseflow.fit(noise_model, signal, observation, **given)

    series = smooth(20, 20)
    noisy = series.images + noise * np.random.default_rng(0).normal(size=series.images.shape).astype(np.float32)
    short = replace(Schedule(), settle=1, adapt=1, quiet=2, trial=1, describe=1)
    JointReconstructor(run_fit=run_fit, schedule=short, num_steps=4)(replace(series, images=noisy))
    assert fitted
    assert set(fitted) == {not held}


@pytest.mark.parametrize("frozen", [False, True])
def test_a_quiet_series_is_fitted_by_least_squares_whatever_its_noise_model(frozen):
    def made():
        return noiseflow.SplineFlow().requires_grad_(not frozen)

    series, short = smooth(20, 20), replace(Schedule(), settle=1, adapt=1, quiet=2, trial=1, describe=3)
    usual, given = (JointReconstructor(noise_model=each, schedule=short)(series) for each in (None, made))
    np.testing.assert_array_equal(given.volume.attenuation, usual.volume.attenuation)
    assert type(given.noise_model) is noiseflow.SplineFlow
    assert type(given.likelihood) is noiseflow.Gaussian
    before = made().state_dict()
    assert all(bool((after == before[name]).all()) for name, after in given.noise_model.state_dict().items()) == frozen


def test_a_quiet_series_is_said_to_be_fitted_by_least_squares():
    choices = reconstruct(smooth(20, 20), method="joint", num_steps=2, weight=1.0).choices
    assert choices["noise model"].endswith("volume by least squares")


@pytest.mark.parametrize("tilts", [10, 11, 21])
def test_gaps_of_ten_tilts_and_more_are_three_tilts_wide(tilts):
    groups = Holdout.two_gaps(np.linspace(-50, 50, tilts)).groups
    assert min(np.bincount(groups, minlength=3)) >= 3


def test_least_squares_judges_weights_of_a_quiet_series_by_long_trials():
    planned, *_ = JointReconstructor(noise_model=noiseflow.Gaussian).plan(smooth(20, 20))
    assert [stage.num_steps for stage in planned if stage.kind == "weights"] == [Schedule().quiet * 3 // 4]


@pytest.mark.parametrize("tilts", [2, 3, 4, 5, 8])
@pytest.mark.parametrize("noise_model", [None, pytest.param(noiseflow.Gaussian, marks=pytest.mark.slow)])
def test_a_weight_is_found_from_few_tilts_without_noise(tilts, noise_model):
    few = smooth(32, 32).select(np.arange(9) < tilts)
    short = replace(Schedule(), settle=1, adapt=1, quiet=4, trial=1, describe=1)
    found = JointReconstructor(noise_model=noise_model, schedule=short, num_steps=1)(few)
    assert np.isfinite(found.weight)


def test_a_weight_is_judged_alike_whatever_was_tried_before(clipped, monkeypatch):
    found = []

    def tried(held_out_nll, first, **how):
        found.extend(held_out_nll(weight) for weight in (first, 0.0, first))
        return WeightChoice(first, {})

    monkeypatch.setattr("recon.joint.run.choose_weight", tried)
    monkeypatch.setattr("noiseflow.fitting.loop._TABLE_COUNT", 0)  # as of larger series
    JointReconstructor(num_steps=1)(clipped)
    assert found[0] == found[2] != found[1]


def test_stages_are_values():
    assert FitStage("a", "signal", "whole", "simple", 3) == FitStage("a", "signal", "whole", "simple", 3)
    assert total_steps([FitStage("a", "weights", "slab", "simple", 3, fits=5)]) == 15


def test_the_noise_is_learnt_at_the_usual_weight_if_the_user_gives_one() -> None:
    clean, _ = clean_tilt_series(
        make_phantom("shells", 16, generator=np.random.default_rng(1), count=4),
        np.arange(-60, 61, 10.0),
        acquisition=ACQUISITIONS["skewed"],
    )
    weights: dict[str, float] = {}

    def watched(name: str, noise_model: Any, signal: Any, observation: Any, **options: Any) -> noiseflow.FitResult:
        weights[name] = getattr(signal, "weight", np.nan)
        return run_fit(name, noise_model, signal, observation, **options)

    once = Schedule(settle=1, adapt=1, describe=1, whole=4)
    noisy = add_noise(clean, SkewedNoise(0.05, 0.1, skewness=0.7), seed=1)
    JointReconstructor(weight=16.0, schedule=once, run_fit=watched)(noisy)
    assert weights["settle"] == weights["adapt"] < 1
    assert weights["begin"] == weights["fit"] == 16


def test_fits_of_the_volume_use_nearly_all_pixels_and_return_their_last_state(clipped):
    seen: dict[str, Any] = {}

    def recorded(name, noise_model, signal, observation, **options):
        result = run_fit(name, noise_model, signal, observation, **options)
        seen[name] = float(options["held_out"].float().mean()), options.get("keep_last"), result
        return result

    found = JointReconstructor(weight=0.02, noise_model=noiseflow.Gaussian, num_steps=60, run_fit=recorded)(clipped)
    share, keep_last, result = seen["fit"]
    assert share < 0.05 < seen["settle"][0]
    assert keep_last
    assert not seen["settle"][1]
    assert not seen["begin"][1]
    assert found.fit_result is result
    # so weak a penalty overfits: the last state is not the best, but no divergence either
    assert result.held_out_nll == pytest.approx(result.last_nll)
