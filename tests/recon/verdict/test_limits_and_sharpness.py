"""What a detector or a number type cut off, and tilts more blurred than others, are named; good series of all kinds are not."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage

from benchmarks import needle
from benchmarks.sabotage import spoil
from benchmarks.scenes import Scene, make_scene
from noiseflow.checks import LIKELY, Finding, Guard, NotTested, ranked, run
from recon.methods import reconstruct
from recon.projection.image_formation import Linear
from recon.series.screening import screen
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import Acquisition, clean_tilt_series
from recon.verdict import pixels, tilts
from recon.verdict.case import Case
from recon.verdict.compared import Residuals, coarse_series
from recon.verdict.sharpness import blurs
from recon.verdict.table import CHECKS
from tests.independent_scenes import RANGES, independent_series, poisson

NAMES = ("half of the tilts out of focus", "blur that grows with the tilt")


@cache
def scene(phantom: str, noise: str, seed: int = 0) -> Scene:
    return make_scene(48, phantom=phantom, noise=noise, tilts="-60:60:3", seed=seed)


def spoilt(phantom: str, noise: str, name: str) -> TiltSeries:
    return spoil(scene(phantom, noise), name, other=scene(phantom, noise, 9), seed=5).series


@dataclass(frozen=True)
class Shown:
    """Projections as a result."""

    projections: Any
    volume: Any = None
    fit_result: Any = None
    noise_model: Any = None


LIMITS = ("pixels at a limit", "end of the pixel values")
BLUR = ("blur that grows with the tilt", "focus", "magnification of the halves")
LOCAL = ("spikes", "dead pixels", "stuck pixels", "streaks", "filled borders", "steps between columns")
PIXELS = (*LIMITS, *LOCAL, "fixed pattern")


def measured(series: TiltSeries, clean: Any, names: Iterable[str]) -> dict[str, Finding]:
    """Findings of some checks, from clean images as projections."""
    rows = [CHECKS[name] for name in names]
    return run(rows, Case(series, Shown(clean.astype(np.float32))), Guard())


def firing(series: TiltSeries, clean: Any, names: Iterable[str]) -> set[str]:
    """Reasons of some checks that fire."""
    return {each.reason for each in measured(series, clean, names).values() if each.cost >= 1}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
def test_tilts_more_blurred_than_others_are_named(phantom: str, noise: str, name: str) -> None:
    series = spoilt(phantom, noise, name)
    assert firing(series, series.images, BLUR) == {"resolution"}


@pytest.mark.parametrize("noise", ["clipped", "low-dose", "8-bit", "outliers"])
@pytest.mark.parametrize("phantom", ["shells", "filaments", "slab", "atoms"])
def test_good_series_are_neither_blurred_nor_cut_off(phantom: str, noise: str) -> None:
    made = scene(phantom, noise, seed=2)
    assert not firing(made.noisy, made.clean.images, (*LIMITS, *BLUR))


def test_a_mask_keeps_what_it_hides_from_looking_blurred() -> None:
    made = scene("particles", "low-dose")
    images, mask = made.noisy.images.copy(), np.ones(made.noisy.images.shape, dtype=bool)
    mask[20:, 4:44, 4:44] = False
    images[~mask] = images.mean()
    series = TiltSeries(images, made.noisy.tilt_angles, mode="linear", mask=mask)
    assert not firing(series, made.clean.images, BLUR)
    bare = TiltSeries(images, made.noisy.tilt_angles, mode="linear")
    assert firing(bare, made.clean.images, BLUR)


def test_blur_is_measured_in_pixels() -> None:
    y = np.arange(64.0)
    widths = np.linspace(4.0, 5.0, 21)
    bumps = np.exp(-((y - 31.5) ** 2) / (2 * widths[:, None] ** 2)) / widths[:, None]
    values, _ = blurs(np.repeat(bumps[:, :, None], 8, axis=2))
    np.testing.assert_allclose(2 * (values[-1] - values[0]), 5.0**2 - 4.0**2, rtol=0.1)


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
@pytest.mark.parametrize("name", ["saturation", "overflow of the number type"])
def test_values_cut_off_or_wrapped_around_are_named(phantom: str, noise: str, name: str) -> None:
    series = spoilt(phantom, noise, name)
    assert firing(series, scene(phantom, noise).clean.images, LIMITS) == {"saturation"}


def test_few_counts_have_no_pile_at_their_highest() -> None:
    means = 0.3 * scene("particles", "low-dose").clean.images
    counts = np.random.default_rng(0).poisson(means).astype(np.uint8)
    series = TiltSeries(counts, np.arange(-60.0, 61, 3), mode="linear")
    assert not firing(series, means, LIMITS)


@pytest.mark.parametrize("level", [0.02, 0.05, 0.1, 0.3])
def test_empty_columns_beside_a_count_are_no_streaks(level: float) -> None:
    shape = scene("particles", "low-dose").clean.images.shape
    means = np.full((shape[0], 11, shape[2]), level) * np.linspace(1.0, 1.2, 11)[:, None]
    counts = np.random.default_rng(1).poisson(means).astype(np.uint8)
    series = TiltSeries(counts, np.linspace(-60.0, 60, len(counts)), mode="linear")
    assert not firing(series, means, ("streaks",))


def test_halves_of_a_detector_with_another_gain_are_named() -> None:
    made = scene("shells", "clipped")
    series = spoilt("shells", "clipped", "half of the columns with another gain")
    assert "pattern" in firing(series, made.clean.images, PIXELS)
    assert not firing(made.noisy, made.clean.images, PIXELS)


@pytest.mark.parametrize("noise", ["Poisson 10", "Poisson 40, read noise"])
@pytest.mark.parametrize("name", ["gyroid", "smooth_blobs", "vesicles_in_ice"])
@pytest.mark.parametrize("size", [32, 33])
def test_halves_whose_gain_a_volume_follows_are_named(size: int, name: str, noise: str) -> None:
    made = independent_series(name, noise, "±60°/2°", size=size, seed=7)
    level = 10.0 if "read" in noise else 0.0
    gains = np.where(np.arange(size) < size // 2, 1.0, 0.8)
    for images, named in ((made.series.images, False), ((made.series.images - level) * gains + level, True)):
        series = TiltSeries(images, made.series.tilt_angles, mode="linear")
        assert ("pattern" in firing(series, images, ("gain of the halves",))) == named


@pytest.mark.parametrize("column", [7, 20])
@pytest.mark.parametrize(
    ("rows", "named"), [(slice(24), True), (slice(24, 48), True), (slice(8), False), (slice(40, 48), False)]
)
def test_a_step_between_columns_is_one_of_many_rows(column: int, rows: slice, named: bool) -> None:
    made = scene("shells", "clipped")
    images = made.noisy.images.copy()
    images[:, rows, column:] += np.float32(3 * images.std())
    found = measured(replace(made.noisy, images=images), made.clean.images, ("steps between columns",))
    assert (found["steps between columns"].cost > 1) == named


@pytest.mark.parametrize("step", [-3.0, 3.0])
@pytest.mark.parametrize("places", [((20, 30),), ((5, 7), (20, 30)), ((0, 0), (5, 7), (5, 8), (20, 30), (41, 4))])
def test_stuck_pixels_are_named_and_no_other_pattern(step: float, places: Any) -> None:
    made = scene("particles", "low-dose")
    images = made.noisy.images.astype(np.float32)
    for number, (y, x) in enumerate(places, 3):
        images[:, y, x] += np.float32(step * number * images.std())
    found = measured(replace(made.noisy, images=images), made.clean.images, (*LOCAL, "fixed pattern"))
    assert [each.name for each in ranked(found.values())] == ["stuck pixels"]
    largest = [f"y {y}, x {x}" for y, x in places[::-1][:3]]
    assert found["stuck pixels"].effect.what == "; ".join(largest) + " …" * (len(places) > 3)


def test_a_stuck_column_and_gains_of_all_pixels_are_no_stuck_pixels() -> None:
    made = scene("particles", "low-dose")
    images = made.noisy.images.astype(np.float32)
    column, gains = images.copy(), images * np.random.default_rng(0).normal(1, 0.2, images.shape[1:]).astype(np.float32)
    column[:, :, 9] += 10 * images.std()
    for spoilt_by, name in ((column, "steps between columns"), (gains, "fixed pattern")):
        found = measured(replace(made.noisy, images=spoilt_by), made.clean.images, (name, "stuck pixels"))
        assert [each.name for each in ranked(found.values())] == [name]


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", ["faceted_particle_on_film", "text"])
def test_fine_parts_that_a_volume_lacks_are_no_stuck_pixels(name: str) -> None:
    series = independent_series(name, "Poisson 2", "±60°/2°").series
    result = reconstruct(series, VolumeGrid.of(series), method="sirt", num_steps=20)
    assert CHECKS["stuck pixels"].finding(Case(series, result)).cost == 0


@pytest.mark.parametrize(("method", "gains"), [("sirt", 0.0), ("l2", 0.0), ("l2", 0.03)])
def test_gains_of_pixels_are_a_fixed_pattern_and_thin_structure_that_a_volume_lacks_is_none(method, gains) -> None:
    density = make_phantom("filaments", 32, generator=np.random.default_rng(1))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 3.0), acquisition=Acquisition(None, "transmission"))
    spread = gains * clean.images.std() * np.random.default_rng(3).normal(size=clean.images.shape[1:])
    series = replace(clean, images=(clean.images + spread).astype(np.float32))
    weight = 0.4 if method == "l2" else None
    result = reconstruct(series, VolumeGrid.of(series), method=method, num_steps=60 if weight else 30, weight=weight)
    found = CHECKS["fixed pattern"].finding(Case(series, result))
    assert (found.cost > 1) == (gains > 0), found.effect


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
def test_a_dead_region_is_named_until_it_is_masked(phantom: str, noise: str) -> None:
    made = scene(phantom, noise)
    series = spoilt(phantom, noise, "one region black in all images")
    assert "lines" in firing(series, made.clean.images, PIXELS)
    masked = replace(series, mask=made.noisy.images == series.images)
    assert measured(masked, made.clean.images, PIXELS)["dead pixels"].effect.value == 0


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("slab", "8-bit"), ("slab", "low-dose")]
)
def test_vacuum_without_noise_is_not_dead(phantom: str, noise: str) -> None:
    clean = scene(phantom, noise).clean
    assert measured(clean, clean.images, PIXELS)["dead pixels"].effect.value == 0


def unexplained(series: TiltSeries) -> Finding:
    result = reconstruct(series, VolumeGrid.of(series), method="sirt", num_steps=30)
    return CHECKS["unexplained pixels"].finding(Case(series, result))


@pytest.mark.parametrize(("phantom", "noise"), [("virions", "gaussian"), ("particles", "gaussian")])
def test_parts_of_a_detector_without_the_specimen_are_named(phantom: str, noise: str) -> None:
    """Rows of noise, and a spot that is too bright, in all tilts."""
    clean = scene(phantom, noise).noisy
    rows, spot = clean.images.astype(np.float32), clean.images.astype(np.float32)
    low, high = np.quantile(rows, (0.01, 0.99))
    rows[:, 10:16] = np.random.default_rng(0).uniform(low, high, rows[:, 10:16].shape)
    spot[:, 20:23, 30:33] += 2 * (high - low)
    for images, where in ((clean.images, ""), (rows, "rows 10 to 15"), (spot, "rows 20 to 22, columns 30 to 3")):
        found = unexplained(replace(clean, images=images))
        assert (found.cost > 1) == bool(where), found.effect
        assert found.effect.what.startswith(where)


@pytest.mark.parametrize(
    ("name", "noise"), [("text", "Poisson 2"), ("smooth_blobs", "outliers"), ("tilted_slab", "detector blur")]
)
def test_counts_tails_and_misfit_of_unspoilt_series_show_the_specimen(name: str, noise: str) -> None:
    assert unexplained(independent_series(name, noise, "±70°/5°").series).cost == 0


def test_rows_that_an_alignment_fills_are_left_to_the_check_of_borders() -> None:
    series = needle.load()  # its upper rows are zero in half of the tilts
    assert (series.images[:, 0] == 0).all(1).mean() > 0.4
    case = Case(series, reconstruct(series, VolumeGrid.of(series), method="sirt"))
    assert CHECKS["unexplained pixels"].finding(case).cost == 0


def test_one_direction_has_no_gap_inside_its_range() -> None:
    clean = scene("virions", "gaussian").noisy
    two = replace(clean.select([0, 1]), tilt_angles=np.array([0.0, 180.0]))
    assert (
        CHECKS["gap inside the range"].finding(Case(two, reconstruct(two, VolumeGrid.of(two), method="sirt"))).cost == 0
    )


def test_few_tilts_and_flat_projections_leave_pixels_unjudged() -> None:
    clean = scene("virions", "gaussian").noisy
    few = clean.select(np.arange(0, clean.num_tilts, clean.num_tilts // 3)[:3])
    with pytest.raises(NotTested, match="tilts"):
        unexplained(few)
    noise, flat = clean.images.astype(np.float32), np.ones(clean.images.shape, np.float32)
    residuals = Residuals.of(replace(clean, images=noise), flat)
    with pytest.raises(NotTested, match="structure"):
        pixels.unexplained(residuals, slice(0, noise.shape[1]))
    exact = Residuals.of(replace(clean, images=noise), noise)
    assert pixels.unexplained(exact, slice(0, noise.shape[1])).value == 0


def test_copies_of_images_raise_no_warning() -> None:
    series = spoilt("particles", "low-dose", "one image repeated over a third of the tilts")
    coarse = coarse_series(series, VolumeGrid.of(series, None))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(tilts.jumps(coarse).value)
    assert tilts.repeated(series).value > 0.3


@pytest.mark.parametrize(("exponent", "named"), [(1.0, False), (0.7, True)])
def test_a_response_that_compresses_strong_contrast_is_named(exponent: float, named: bool) -> None:
    made = scene("particles", "low-dose")
    clean = made.clean.images / made.clean.images.max()
    noisy = clean**exponent + np.random.default_rng(0).normal(0, 0.02, clean.shape)
    series = TiltSeries(noisy, made.noisy.tilt_angles, mode="linear")
    shown = Shown((clean**exponent).astype(np.float32), Volume(made.truth.astype(np.float32)))
    found = CHECKS["response"].finding(Case(series, shown))
    assert (found.cost >= 1) == named, found.effect


def test_the_verdict_judges_images_that_the_response_of_the_fit_straightens() -> None:
    made = scene("particles", "low-dose")
    lines = torch.from_numpy(made.clean.images / made.clean.images.max()).float()
    bent = Linear()
    bent.bend.fill_(1.5)

    def case(images: torch.Tensor, response: Linear) -> Case:
        series = TiltSeries(images.detach().numpy(), made.noisy.tilt_angles, mode="linear")
        shown = Shown(series.images, Volume(made.truth.astype(np.float32)))
        return Case(series, SimpleNamespace(**vars(shown), signal_model=SimpleNamespace(image_formation=response)))

    true = case(lines, Linear())
    for response, alike in ((bent, True), (Linear(), False)):
        found = case(bent(lines), response)
        errors = [
            found.coarse.images - true.coarse.images,
            found.own[0] - true.own[0],
            found.integrals - true.integrals,
        ]
        assert all((np.abs(error).max() < 0.05) == alike for error in errors)


def test_images_scaled_one_by_one_are_named() -> None:
    images = scene("particles", "low-dose").noisy.images.astype(np.float64)
    assert tilts.normalised(TiltSeries(images, np.arange(-60.0, 61, 3), mode="linear")).value == 0
    scaled = (images - images.mean((1, 2), keepdims=True)) / images.std((1, 2), keepdims=True)
    assert tilts.normalised(TiltSeries(scaled, np.arange(-60.0, 61, 3), mode="linear")).value == 1
    low, high = images.min((1, 2), keepdims=True), images.max((1, 2), keepdims=True)
    scaled = np.round(255 * (images - low) / (high - low)).astype(np.uint8)
    assert tilts.normalised(TiltSeries(scaled, np.arange(-60.0, 61, 3), mode="linear")).value == 1


def test_images_of_a_round_object_are_not_scaled_one_by_one() -> None:
    lines = independent_series("core_shell", poisson(1), RANGES["0…177°/3°"], size=40).clean
    assert tilts.normalised(TiltSeries(1000 * np.exp(-lines / lines.max()), RANGES["0…177°/3°"])).value == 0


def test_vacuum_at_a_pedestal_is_not_dead_beside_what_an_alignment_fills() -> None:
    clean = scene("shells", "clipped").clean
    images, expected = clean.images + 20.0, clean.images + 20.01
    images[:, :3] = 0.0
    found = pixels.dead_pixels(Residuals.of(replace(clean, images=images), expected))
    assert found.mean() == pytest.approx(3 / images.shape[1])


def test_a_still_part_with_a_value_of_its_own_in_every_pixel_is_dead_at_once() -> None:
    clean = scene("shells", "clipped").clean
    images = np.array(clean.images)
    images[:, :24] = images[0, :24] + np.random.default_rng(0).uniform(0, 0.1, images[0, :24].shape)
    found = pixels.dead_pixels(Residuals.of(replace(clean, images=images), clean.images + 0.01))
    assert found.mean() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("mean", [0.05, 10.0])
def test_pixels_without_counts_are_dead_only_where_that_is_no_chance(mean: float) -> None:
    place = np.linspace(-1, 1, 32)
    signal = np.broadcast_to(6 * mean * np.exp(-8 * (place**2 + place[:, None] ** 2)), (31, 32, 32))
    counts = np.random.default_rng(0).poisson(signal).astype(np.float32)
    angles = np.linspace(-60, 60, 31)
    assert not pixels.dead_pixels(Residuals.of(TiltSeries(counts, angles, mode="linear"), signal)).any()
    counts[:, 12:20, 12:20] = 0
    assert pixels.dead_pixels(Residuals.of(TiltSeries(counts, angles, mode="linear"), signal)).any()


@pytest.mark.parametrize("part", ["corners", "columns"])
def test_what_lies_below_all_other_values_is_dead_and_no_saturation(part: str) -> None:
    """Also where the volume follows it, as a haze in the shape of the mask."""
    clean, generator = scene("shells", "clipped").clean, np.random.default_rng(0)
    images = 300 + 200 * clean.images / clean.images.max() + generator.normal(0, 5, clean.images.shape)
    place = np.arange(images.shape[2]) - (images.shape[2] - 1) / 2
    gone = np.hypot(place[:, None], place) > 0.48 * len(place) if part == "corners" else np.abs(place - 3) < 1
    images[:, np.broadcast_to(gone, images.shape[1:])] = 0
    residuals = Residuals.of(replace(clean, images=images, mode="transmission"), images + 0.01)
    assert (pixels.dead_pixels(residuals) == gone).all()
    assert pixels.piled(residuals, "low").value == 0


def test_rows_that_are_filled_in_some_images_are_borders() -> None:
    """A volume follows them: what it predicts is no evidence, but tilting moves nothing to other rows."""
    clean = scene("shells", "clipped").clean
    images = clean.images + 0.05 * clean.images.max() * np.random.default_rng(0).normal(size=clean.images.shape)
    for filled in (slice(0, 0), slice(0, None, 4)):
        images[filled, -3:] = images.mean()
        found = pixels.borders(Residuals.of(replace(clean, images=images), images + 0.01))
        assert found.value == pytest.approx(np.isin(np.arange(len(images)), np.arange(len(images))[filled]).mean())


@pytest.mark.parametrize(("factor", "named"), [(1.0, False), (1.2, True)])
@pytest.mark.parametrize("tilts", ["0…177°/3°", "±60°/2°"])
def test_a_wrong_scale_of_the_angles_is_named_where_tilts_determine_it(tilts: str, factor: float, named: bool) -> None:
    made = independent_series("beads", "Poisson 100", tilts, size=32, seed=3)
    series = replace(made.series, tilt_angles=made.series.tilt_angles * factor)
    found = CHECKS["scale of the angles"].finding(
        Case(series, Shown(made.clean.astype(np.float32), Volume(made.truth)))
    )
    assert (found.cost >= 1) == (named and tilts.startswith("0")), found.effect


@pytest.mark.parametrize(("left", "named"), [(1.0, False), (0.7, True)])
def test_a_specimen_that_loses_contrast_is_named(left: float, named: bool) -> None:
    images = scene("particles", "low-dose").noisy.images * np.linspace(1, left, 41)[:, None, None]
    series = TiltSeries(images, np.arange(-60.0, 61, 3), mode="linear")
    found = CHECKS["trend of the beam"].finding(Case(series, Shown(images), screen(series)))
    assert (found.cost >= 1) == named, found.effect
    assert (found.effect.value < -0.5 * (1 - left)) == named


def test_neighbouring_residuals_share_misfit_in_proportion_and_no_independent_noise() -> None:
    shape, random = (9, 24, 32), np.random.default_rng(0)
    structure = np.broadcast_to(np.sin(np.arange(32) / 5) + np.cos(np.arange(24) / 7)[:, None], shape)
    projections = np.ascontiguousarray(structure - structure.mean(), np.float32)

    def shared(images: np.ndarray) -> float:
        return Residuals.of(
            TiltSeries(images.astype(np.float32), np.linspace(-60, 60, 9), mode="linear"), projections
        ).shared()

    assert shared(1.1 * projections) == pytest.approx(0.01, rel=0.1)
    assert shared(projections + random.normal(0, 0.3, shape)) < 0.005


def test_a_rod_about_the_axis_is_no_step_between_columns() -> None:
    place = np.arange(40) - 19.5
    rod = np.sqrt(np.maximum(8**2 - place**2, 0)) + 3 * (np.abs(place) < 8)
    images = np.repeat(rod[None, None], 40, 1).repeat(21, 0).astype(np.float32)
    step = images + 6 * (place > 3.5).astype(np.float32)
    for shown, most in ((images, 0.05), (step, np.inf)):
        series = TiltSeries(shown, np.linspace(-60, 60, 21), mode="linear")
        value = pixels.seam(Residuals.of(series, images)).value
        assert value < most
    assert value > 0.35


def test_a_wire_beside_the_axis_is_no_step_between_columns() -> None:
    place = np.arange(64) - 31.5
    wire = 100 * np.sqrt(np.maximum(3**2 - (place - 1.5) ** 2, 0))
    images = np.repeat(wire[None, None], 64, 1).repeat(21, 0).astype(np.float32)
    series = TiltSeries(images, np.linspace(-60, 60, 21), mode="linear")
    for left, found in ((0.05, False), (0.3, True)):  # the share that the volume leaves
        value = pixels.seam(Residuals.of(series, (1 - left) * images)).value
        assert (value > 0.35) == found
    halves = pixels.halves(images)
    assert halves.value < LIKELY * halves.error


@pytest.mark.parametrize("read_noise", [0.0, 2.0])
@pytest.mark.parametrize("level", [0.0, 30.0, 80.0])
def test_noise_that_does_not_vanish_at_zero_shows_a_dark_level(level: float, read_noise: float) -> None:
    """Counts have none, whatever their read noise, which makes the level that is named too low."""
    finding = dark_level(scene("shells", "gaussian", 3), 100, level, read_noise)
    assert (finding.cost > 1) == (level > 0)
    assert level == 0 or level - 1.5 * read_noise**2 - 8 < float(finding.effect.what) < level + 8


@pytest.mark.parametrize(
    ("phantom", "spoil"),
    [
        ("shells", "gains of the tilts"),
        ("filaments", "beams of the tilts"),  # cost 3.1 if the neighbouring tilts keep their own beams
        ("shells", "hot pixels"),
        ("shells", "noise in proportion"),
    ],
)
def test_other_noise_is_no_dark_level(phantom: str, spoil: str) -> None:
    assert dark_level(scene(phantom, "gaussian", 4), 150, 0.0, 0.0, spoil).cost == 0


def dark_level(made: Scene, counts: float, level: float, read_noise: float, also: str = "") -> Finding:
    clean, random = ndimage.gaussian_filter(made.clean.images, (0, 1, 1)), np.random.default_rng(1)
    gain = 1 / np.cos(np.deg2rad(made.clean.tilt_angles))[:, None, None] if also == "gains of the tilts" else 1.0
    if also == "beams of the tilts":
        clean = clean * random.normal(1, 0.2, (len(clean), 1, 1))
    images = random.poisson(counts * gain * clean) / gain + random.normal(0, read_noise, clean.shape) + level
    if also == "hot pixels":
        images[random.random(images.shape) < 0.002] += 5 * counts
    if also == "noise in proportion":
        images = counts * clean * random.normal(1, 0.1, clean.shape)
    series = TiltSeries(images.astype(np.float32), made.clean.tilt_angles, mode="transmission")
    case: Any = SimpleNamespace(series=series, residuals=Residuals.of(series, np.float32(counts * clean + level)))
    return CHECKS["dark level"].finding(case)
