"""Angles are directions modulo 180°: any range, any order, and mirror images half a turn apart give a good volume and verdict."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import recon
from benchmarks.coverage import inner_views
from recon.metrics.metrics import compare
from recon.series.holdout import Holdout
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.series.views import Directions
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from recon.verdict.compared import Coarse
from recon.verdict.geometry import GapFit
from recon.verdict.judge import judge

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # angles that occur twice are meant

GOLDEN = 180 * (np.sqrt(5) - 1) / 2
ORDERS = {
    "±60°": np.arange(-60, 61, 3.0),
    "0…177°": np.arange(0, 178, 4.5),
    "0…180°": np.arange(0, 181, 4.5),
    "0…350°": np.arange(0, 351, 7.5),
    "0…360°": np.arange(0, 361, 7.5),
    "±90°": np.arange(-90, 91, 4.5),
    "mirrored duplicates": np.r_[np.arange(-60, 61, 6.0), np.arange(120, 241, 6.0)],
    "dose-symmetric": np.array(sorted(np.arange(-60, 61, 3.0), key=lambda a: (abs(a), a))),
    "golden ratio": (np.arange(40) * GOLDEN) % 180 - 90,
    "golden ratio, full turn": (np.arange(40) * GOLDEN) % 360,
}


def evenly_spaced_views(angles: Any, every: int) -> Any:
    return Holdout.views(angles, every).groups == 1


def made(angles: Any) -> tuple[TiltSeries, Any]:
    density = make_phantom("particles", 40, generator=np.random.default_rng(0))
    acquisition = ACQUISITIONS["low-dose"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clean, unit = clean_tilt_series(density, angles, acquisition=acquisition)
        assert acquisition.noise is not None
        return add_noise(clean, acquisition.noise(), seed=1), density * unit


@pytest.mark.parametrize("name", ORDERS)
@pytest.mark.usefixtures("one_thread")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_every_order_gives_its_volume_and_a_good_verdict(name: str) -> None:
    series, truth = made(ORDERS[name])
    prepared = recon.prepare(series)
    result = recon.reconstruct(prepared.tilt_series, VolumeGrid.of(series), method="l2", weight=1.0, num_steps=100)
    verdict = judge(prepared.tilt_series, result, screening=prepared.screening, guard=prepared.guard)
    assert prepared.tilt_series.num_tilts == series.num_tilts
    assert not prepared.screening.suspect.any()
    assert compare(result.volume.attenuation, truth, scaling="affine").psnr > 28
    assert verdict.grade == "good", verdict.reasons
    assert not verdict.not_tested.keys() & {"held-out gaps of tilts", "changes between tilts", "single tilts"}


@pytest.mark.parametrize("name", ["0…350°", "±90°"])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_images_half_a_turn_apart_that_are_no_mirror_images_are_seen(name: str) -> None:
    series, _ = made(ORDERS[name])
    images = series.images.copy()
    beyond = series.tilt_angles >= (90 if name == "±90°" else 180)
    images[beyond] = images[beyond, :, ::-1]
    wrong = series.with_images(images, None)
    result = recon.reconstruct(wrong, VolumeGrid.of(series), method="sirt", num_steps=20)
    assert judge(wrong, result).grade != "good"


@pytest.mark.parametrize("name", ORDERS)
def test_directions_lie_within_half_a_turn_and_mirror_few_images(name: str) -> None:
    angles = ORDERS[name]
    found = Directions.of(angles)
    assert found.span < 180
    half_turns = (found.angles - angles) / 180
    np.testing.assert_allclose(half_turns, np.round(half_turns), atol=1e-6)
    assert found.mirrored.mean() <= 0.5
    assert (np.diff(found.angles[found.order]) >= 0).all()
    clean, _ = clean_tilt_series(np.random.default_rng(0).random((8, 3, 8)), angles)
    same, _ = clean_tilt_series(np.random.default_rng(0).random((8, 3, 8)), found.angles[found.order])
    np.testing.assert_allclose(found.arranged(clean.images), same.images, atol=1e-4)


@pytest.mark.parametrize("name", ORDERS)
@pytest.mark.parametrize(("held_out", "every"), [(inner_views, 8), (evenly_spaced_views, 4)])
def test_a_direction_is_held_out_with_its_mirror_images(name: str, held_out: Any, every: int) -> None:
    angles = ORDERS[name]
    out = held_out(angles, every)
    assert 0 < out.mean() < 0.4
    apart = np.abs((angles[out][:, None] - angles[~out] + 90) % 180 - 90)
    assert apart.min() > 0.3  # no tilt that is left shows a direction that was held out
    np.testing.assert_array_equal(held_out(angles + 180, every), out)
    directions, groups = Directions.of(angles), Holdout.gaps(angles).groups
    assert (np.diff(groups[directions.order]) >= 0).all()


@pytest.mark.parametrize("name", ORDERS)
def test_left_out_tilts_are_predicted_alike_half_a_turn_away(name: str) -> None:
    """A mirror image at the angle plus 180° has the error of the image, mirrored."""
    angles = ORDERS[name]
    images = np.random.default_rng(0).random((len(angles), 2, 8))
    turned = np.arange(len(angles)) % 3 == 0
    coarse = Coarse(images, np.ones(images.shape, bool), angles, np.arange(len(angles)), 1, 8, 8, 0.0)
    errors = GapFit(coarse, 0.1).errors(images)
    other = GapFit(replace(coarse, tilt_angles=angles + 180 * turned), 0.1)
    mirrored = np.where(turned[:, None, None], images[:, :, ::-1], images)
    found = np.where(turned[:, None, None], other.errors(mirrored)[:, :, ::-1], other.errors(mirrored))
    np.testing.assert_allclose(found, errors, atol=1e-3)


def test_outer_tilts_lie_beside_the_wedge():
    angles = np.array([0, 30, -30, 60, -60, 57, 120, -45.0])  # 120 and −60 are one direction
    assert list(Holdout.as_missing(angles, 0.16).groups) == [0, 0, 0, 2, 1, 2, 1, 0]
    with pytest.raises(ValueError, match="too few"):
        Holdout.as_missing(np.array([-60.0, 60.0]), 0.16)


@pytest.mark.parametrize("step", [1.0, 3.0, 7.5])
def test_without_a_wedge_every_fifth_tilt_is_left_out(step: float) -> None:
    angles = np.arange(0, 180, step)
    assert np.array_equal(Holdout.as_missing(angles, 0.2).groups, Holdout.views(angles, 5).groups)
    assert Holdout.as_missing(angles[angles < 150], 0.2).last == 2
