"""The coarse start lies where the volume lies, whatever binning leaves over at the edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from recon import JointReconstructor, reconstruct
from recon.joint.coarse_start import coarse_start, start_of
from recon.projection.image_formation import Transmission
from recon.series.tilt_series import VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from recon.verdict.judge import judge
from tests.independent_scenes import independent_series
from tests.recon.series.test_contrast import section


def test_the_middle_stays_in_the_middle_where_pixels_are_left_over() -> None:
    """51 pixels make 12 of four and leave three, on one side."""
    place = np.arange(51) - 25.0
    ball = np.exp(-(place[:, None, None] ** 2 + place[:, None] ** 2 + place**2) / 128).astype(np.float32)
    series, _ = clean_tilt_series(ball, np.arange(-60, 61, 10.0))
    generator = torch.Generator().manual_seed(0)
    volume, _ = coarse_start(series, Transmission(1.0), VolumeGrid.of(series), num_steps=80, generator=generator)
    along_x = volume.clamp_min(0).sum((0, 1))
    middle = float((along_x * (torch.arange(len(along_x)) - (len(along_x) - 1) / 2)).sum() / along_x.sum())
    assert abs(middle) < 0.3  # 0.8 coarse voxels, three fine ones, with the remainder on the wrong side


@pytest.mark.parametrize(
    ("scene", "widened"), [("truncated_object", True), ("vesicles_in_ice", False), ("beads", False)]
)
def test_a_grid_is_as_wide_as_the_object(scene: str, widened: bool) -> None:
    """The slab reaches 1.4 times as far as the field of view; ice ends with it."""
    series = independent_series(scene, "Poisson 10", "±60°/2°").series
    start = start_of(series, VolumeGrid.of(series), estimate=True, seed=0, widen=True)
    assert bool(start.margin) == widened


@pytest.mark.slow
def test_a_slab_that_ends_with_the_grid_gets_no_margin_from_the_lower_noise_of_larger_bins() -> None:
    """Bins of 4 and 6 pixels were compared; without the margin, volumes of clipped noise are 0.5 dB better."""
    acquisition = ACQUISITIONS["8-bit"]
    density = make_phantom("slab", 96, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(density, np.arange(-59.5, 58, 1.5), acquisition=acquisition)
    series = add_noise(clean, acquisition.noise(), seed=1)
    assert start_of(series, VolumeGrid.of(series), estimate=True, seed=0, widen=True).margin == 0


# the others take twice as long
@pytest.mark.parametrize("seed", [*(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 1)), 2])
def test_ice_at_few_tilts_gets_no_margin_by_chance(seed: int) -> None:
    series = independent_series("vesicles_in_ice", "scan noise", "±50°/10°").series
    assert start_of(series, VolumeGrid.of(series), estimate=True, seed=seed, widen=True).margin == 0


def test_the_offset_hardly_depends_on_the_seed() -> None:
    made = independent_series("tilted_slab", "Poisson 40, read noise", "±50°/10°")
    grid, options = VolumeGrid.of(made.series), {"estimate": True, "widen": True}
    starts = [start_of(made.series, grid, seed=seed, **options) for seed in range(4)]
    offsets = [float((start.response.scaled_offset * start.response.offset_unit).detach()) for start in starts]
    assert max(offsets) - min(offsets) < 1  # 3.2 without a tenth of the pixels


def test_no_haze_lowers_the_offset_of_thin_objects() -> None:
    series = independent_series("fibres", "Poisson 40, read noise", "±70°/5°").series
    start = start_of(series, VolumeGrid.of(series), estimate=True, seed=0, widen=True)
    assert (
        float((start.response.scaled_offset * start.response.offset_unit).detach()) > 9
    )  # of 10; 7.1 with a short memory


def test_an_object_that_the_field_of_view_cuts_off_does_not_pile_up_at_its_edges() -> None:
    made = independent_series("truncated_object", "Poisson 40, read noise", "±60°/2°")
    found = reconstruct(made.series, method="l2", weight=1.5, num_steps=60, uncertainty=2)
    volume, edge = found.volume.attenuation, slice(0, 2)
    assert volume.shape == made.truth.shape == found.uncertainty.std.attenuation.shape
    assert volume[:, :, edge].mean() == pytest.approx(
        made.truth[:, :, edge].mean(), rel=0.3
    )  # 2.3 times as much before


@pytest.mark.parametrize("estimate", [True, False])
def test_only_an_offset_that_is_fitted_is_held_above_the_lowest_pixel(estimate: bool) -> None:
    series = independent_series("beads", "Poisson 100", "±70°/5°").series
    model = JointReconstructor(estimate_response=estimate).signal_model(series, VolumeGrid.of(series))
    before = float(model.image_formation.offset)
    model.hold_above(before + 5)
    model.signal()
    assert float(model.image_formation.offset) == pytest.approx(before + 5 * estimate, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("counts", [20, 200])
def test_a_section_keeps_its_mass_and_is_good(counts: int) -> None:
    """No pixel shows vacuum: with a free offset, the mass was 0.6 to 0.8 of the true one. It was bad for what lies beside."""
    made = section("linear", vacuum=0, width=32)
    images = np.random.default_rng(0).poisson(counts / 100 * made.images) + 30.0
    series = replace(made, images=images.astype(np.float32))
    found = reconstruct(series)
    assert float(found.choices["offset"]) == pytest.approx(30, abs=0.04 * float(np.median(images) - 30))
    assert judge(series, found).grade == "good"
    moved = np.random.default_rng(1).uniform(-3, 3, len(images))
    shifted = [
        ndimage.shift(image, (0, shift), order=1, mode="nearest") for image, shift in zip(images, moved, strict=True)
    ]
    wrong = replace(series, images=np.array(shifted, np.float32))
    assert judge(wrong, reconstruct(wrong)).grade != "good"
