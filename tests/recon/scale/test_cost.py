"""The expected time follows the steps, the slices, and the voxels that are not skipped."""

import numpy as np
import pytest

from recon.joint.plan import Facts, FitStage, plan
from recon.scale import memory as cost
from recon.series.tilt_series import VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import clean_tilt_series


@pytest.fixture(scope="module")
def series():
    return clean_tilt_series(
        make_phantom("shells", 16, generator=np.random.default_rng(0)), np.array([-30.0, 0.0, 30.0])
    )[0]


def test_vacuum_and_half_resolution_take_less_time(series, monkeypatch):
    monkeypatch.setattr(cost, "_seconds_of_a_slice", lambda *_: 1.0)

    def expected(share, **facts):
        stages = plan(Facts(settled=True, **facts))
        steps = 16 * sum(stage.num_steps / 8**stage.halvings for stage in stages)  # slices
        return cost.expected_seconds(stages, series, VolumeGrid.of(series), 8, share), steps

    (whole, steps), (empty, _), (halved, fewer) = expected(1.0), expected(0.0), expected(1.0, halvings=1)
    assert fewer == pytest.approx((3 / 4 + 1 / 4 / 8) * steps)  # a quarter of the steps, on an eighth of the voxels
    assert whole == pytest.approx(1.5 * steps, rel=0.01)
    assert empty == pytest.approx(0.5 * steps, rel=0.01)
    assert halved == pytest.approx(1.5 * fewer, rel=0.01)


def test_a_choice_of_the_field_takes_as_long_as_its_fits(series, monkeypatch):
    monkeypatch.setattr(cost, "_seconds_of_a_slice", lambda *_: 1.0)
    stages = plan(Facts())
    choice = FitStage("choose field", "fields", "slab", "chosen", 150, fits=3)

    def expected(stages):
        return cost.expected_seconds(stages, series, VolumeGrid.of(series), 16)

    whole = [stage for stage in stages if stage.where == "whole"]
    usual, of_volume = expected(stages), expected(whole)
    assert expected([choice, *stages]) == pytest.approx(2 * usual + 2 * of_volume, rel=0.02)
