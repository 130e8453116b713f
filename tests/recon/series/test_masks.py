"""Masks are honoured everywhere: whatever is under a mask changes no alignment, no screening and no finding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import recon
from recon.series.alignment_search import find_alignment
from recon.series.first_guess import contrast_slab, estimate_response, explained
from recon.series.masks import binned, coarse, plausible, without_spikes
from recon.series.screening import screen
from recon.series.tilt_series import TiltSeries, Volume
from recon.series.views import level_of
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from recon.verdict.compared import Coarse
from recon.verdict.geometry import GapFit
from recon.verdict.judge import judge

KINDS = {
    "bright field": ("shells", "clipped", np.arange(-60, 61, 3.0)),
    "HAADF": ("particles", "8-bit", np.arange(-60, 61, 3.0)),
    "counts": ("particles", "low-dose", np.arange(-60, 61, 3.0)),
    "0…177°": ("particles", "low-dose", np.arange(0, 178, 4.0)),
}
GARBAGE = {"zeros": 0.0, "huge": 1e6, "noise": None}


@dataclass(frozen=True)
class Known:
    """The truth as a result."""

    volume: Volume
    projections: Any
    fit_result: Any = None
    noise_model: Any = None


@cache
def made(kind: str) -> tuple[TiltSeries, Known]:
    phantom, noise, angles = KINDS[kind]
    acquisition, density = ACQUISITIONS[noise], make_phantom(phantom, 40, generator=np.random.default_rng(0))
    clean, unit = clean_tilt_series(density, angles, acquisition=acquisition)
    assert acquisition.noise is not None
    truth, model = Volume((density * unit).astype(np.float32)), acquisition.noise()
    return add_noise(clean, model, seed=1), Known(truth, clean.images.astype(np.float32), noise_model=model)


def bordered(series: TiltSeries, garbage: str) -> TiltSeries:
    """A border of a fifth of the pixels is masked and holds garbage."""
    mask, images = np.ones(series.images.shape, bool), series.images.astype(np.float32)
    height, width = mask.shape[1:]
    mask[:, : height // 20], mask[:, -(height // 20) :] = False, False
    mask[:, :, : width // 20], mask[:, :, -(width // 20) :] = False, False
    value = GARBAGE[garbage]
    wrong = np.random.default_rng(3).normal(0, images.std(), images.shape) if value is None else value
    return replace(series, images=np.where(mask, images, wrong).astype(np.float32), mask=mask)


@pytest.mark.parametrize("garbage", GARBAGE)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("one_thread")
def test_a_masked_border_changes_no_screening_and_no_finding(kind: str, garbage: str) -> None:
    series, known = made(kind)
    masked = bordered(series, garbage)
    for each in (series, masked) if garbage == "zeros" else (masked,):
        found, verdict = screen(each), judge(each, known)
        assert not found.bad.any()
        assert not found.suspect.any()
        assert not found.beam_drifts
        assert verdict.grade == "good", verdict.reasons
    assert explained(coarse(masked)) == pytest.approx(explained(coarse(series)), abs=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_under_a_mask_is_never_read(kind: str) -> None:
    """Estimates are the same to the last bit, whatever is under the mask."""
    series, _ = made(kind)
    first, second = (bordered(series, garbage) for garbage in ("zeros", "huge"))
    for measure in (estimate_response, level_of, lambda each: contrast_slab(each, 8), screen):
        assert repr(vars_of(measure(first))) == repr(vars_of(measure(second)))
    np.testing.assert_array_equal(plausible(first).images, plausible(second).images)


def vars_of(found: Any) -> Any:
    state = getattr(found, "state_dict", None)
    return state() if state is not None else found.as_dict() if hasattr(found, "as_dict") else found


@pytest.mark.parametrize("garbage", ["zeros", "huge"])
@pytest.mark.usefixtures("one_thread")
def test_a_masked_border_changes_no_alignment(garbage: str) -> None:
    series, _ = made("HAADF")
    moved = replace(series, images=np.stack([np.roll(i, n % 3 - 1, 1) for n, i in enumerate(series.images)]))
    alone, masked = (find_alignment(each, tilt_axis=0.0) for each in (moved, bordered(moved, garbage)))
    assert masked.tilt_axis == pytest.approx(alone.tilt_axis, abs=0.3)
    assert np.abs(masked.shifts - alone.shifts).max() < 0.25


def test_binned_images_are_means_of_used_pixels() -> None:
    images, mask = np.arange(64.0).reshape(2, 4, 8), np.ones((2, 4, 8), bool)
    mask[0, :2, 0], mask[0, :2, 4:7] = False, False
    small = binned(TiltSeries(np.where(mask, images, 1e9), [0.0, 10.0], mask=mask), 2, 2)
    assert small.images[0, 0, 0] == np.mean([1, 9])
    assert small.used[0, 0].tolist() == [True, True, False, True]
    assert small.images[0, 0, 2] in (small.images[0, 0, 1], small.images[0, 0, 3], small.images[0, 1, 2])
    np.testing.assert_array_equal(small.images[1], images[1].reshape(2, 2, 4, 2).mean((1, 3)))


@pytest.mark.usefixtures("one_thread")
def test_a_masked_fit_of_gaps_is_that_of_the_used_rays() -> None:
    """Compared with the fit to a series in which these rays are absent, as whole tilts."""
    generator, angles = np.random.default_rng(0), np.linspace(-60, 60, 21)
    images, used = generator.normal(size=(21, 3, 9)), np.ones((21, 3, 9), bool)
    used[7] = False
    masked = GapFit(Coarse(images, used, angles, np.arange(21), 1, 8, 9, 0.0), 0.3)
    rest = np.arange(21) != 7
    rays, some = (np.float32(each.transpose(0, 2, 1).reshape(-1, 3)) for each in (images, used))
    found = masked._completed(rays, some)
    left = found - masked.half.T @ (masked.half @ found)
    assert float(np.abs(left.reshape(21, 9, 3)[~rest]).max()) < 2e-3


def test_a_mask_file_that_excludes_nothing_gives_a_warning(tmp_path: Any) -> None:
    images = np.random.default_rng(0).random((3, 8, 8)).astype(np.float32)
    recon.write_tilt_series(tmp_path / "tilts.mrc", TiltSeries(images, [-30.0, 0.0, 30.0]))
    with pytest.warns(UserWarning, match="excludes no pixel"):
        recon.read_tilt_series(tmp_path / "tilts.mrc", mask=np.ones((8, 8), bool))


def test_single_hot_pixels_are_spikes_and_a_small_particle_is_none() -> None:
    random = np.random.default_rng(0)
    images = random.normal(0, 0.1, (9, 40, 40)).astype(np.float32)
    images[:, 20:22, 20:22] += 30
    hot = random.random(images.shape) < 0.001
    hot[:, 18:24, 18:24] = False
    series = TiltSeries(np.where(hot, np.float32(50), images), np.linspace(-60, 60, 9), mode="linear")
    np.testing.assert_array_equal(without_spikes(series).used, ~hot)
