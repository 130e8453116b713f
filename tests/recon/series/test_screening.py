"""Tilts that do not belong, and a beam that drifts, are found before the reconstruction."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from benchmarks.needle import load
from recon.fields.kinds.grids import VoxelField
from recon.joint.joint import JointReconstructor
from recon.joint.signal_model import TomographySignal
from recon.metrics.metrics import compare
from recon.projection.image_formation import Linear, Transmission
from recon.projection.projector import SliceProjector
from recon.reconstruction import Reconstruction
from recon.report.page import reconstruction_report
from recon.series.first_guess import beyond_sides
from recon.series.masks import coarse
from recon.series.prepare import prepare
from recon.series.screening import mode_of_good_tilts, screen
from recon.series.tilt_series import TiltSeries, Volume
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from tests.independent_scenes import independent_series
from tests.recon.series.test_contrast import section

ANGLES = np.arange(-60, 61, 3.0)


def scene(noise="clipped", phantom="shells", size=48):
    """Truth, clean series, and a function that draws its noise."""
    density, clean = _clean(noise, phantom, size)
    return density, clean, lambda series: add_noise(series, ACQUISITIONS[noise].noise(), seed=1)


@cache
def _clean(noise, phantom, size):
    density = make_phantom(phantom, size, generator=np.random.default_rng(0))
    clean, unit = clean_tilt_series(density, ANGLES, acquisition=ACQUISITIONS[noise])
    return density * unit, clean


def changed(clean, tilt, how):
    images = clean.images.copy()
    images[tilt] = how(images)
    return replace(clean, images=images)


DAMAGES = {
    "shifted": lambda images: np.roll(images[7], 6, 1),
    "of another tilt": lambda images: images[30],
    "shaded": lambda images: images[7] * np.linspace(0.1, 1, images.shape[2], dtype=np.float32),
    "blank": lambda images: np.full_like(images[7], np.quantile(images, 0.9)),
    "dark": lambda images: np.zeros_like(images[7]),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("noise", ["clipped", "low-dose"])
def test_a_tilt_that_does_not_belong_is_found(noise, damage):
    _, clean, noisy = scene(noise)
    found = screen(noisy(changed(clean, 7, DAMAGES[damage])))
    assert np.flatnonzero(found.bad).tolist() == [7]


@pytest.mark.parametrize("noise", ["clipped", "skewed", "outliers", "low-dose", "8-bit"])
@pytest.mark.parametrize("phantom", ["shells", "filaments", "particles", "slab"])
def test_good_series_loses_no_tilt_and_has_a_steady_beam(phantom, noise):
    _, clean, noisy = scene(noise, phantom)
    series = noisy(clean)
    passed = screen(series).passed(series)
    assert passed.num_tilts == series.num_tilts
    assert passed.beam is None


@pytest.mark.parametrize(("noise", "error"), [("gaussian", 0.01), ("low-dose", 0.04)])
def test_drift_of_the_beam_is_estimated(noise, error):
    _, clean, noisy = scene(noise)
    beam = np.exp(0.1 * np.random.default_rng(2).normal(size=len(ANGLES)))
    series = noisy(replace(clean, images=(clean.images * beam[:, None, None]).astype(np.float32)))
    passed = screen(series).passed(series)
    assert passed.num_tilts == series.num_tilts
    assert np.std(np.log(passed.beam / beam)) < error


@pytest.mark.parametrize("scene", ["core_shell", "off_axis", "text"])
def test_exposures_that_grow_with_the_tilt_are_no_chance(scene):
    made = independent_series(scene, "Poisson 100", "±50°/10°", size=32, seed=5)
    beam = 1 / np.cos(np.deg2rad(made.series.tilt_angles))
    images = np.random.default_rng(0).poisson(made.series.images * beam[:, None, None])
    found = screen(replace(made.series, images=images))
    assert np.std(np.log(found.beam / beam)) < 0.2 * np.std(np.log(beam))


@pytest.mark.parametrize("drift", [0.0, 0.03])
@pytest.mark.parametrize("counts", [30, 300])
@pytest.mark.parametrize("scene", ["faceted_particle_on_film", "gyroid", "vesicles_in_ice"])
def test_a_beam_of_bright_field_that_changes_little_from_tilt_to_tilt_is_found(scene, counts, drift):
    made, random = independent_series(scene, "Poisson 10", "±60°/2°", size=32, seed=4), np.random.default_rng(6)
    beam = np.exp(drift * random.normal(size=made.series.num_tilts))
    clean = counts * beam[:, None, None] * np.exp(-1.2 * made.clean / made.clean.max())
    found = screen(TiltSeries(random.poisson(clean).astype(np.float32), made.series.tilt_angles, mode="transmission"))
    assert found.beam_drifts == (drift > 0)
    assert np.std(np.log(found.beam / beam)) < 0.02


@pytest.mark.parametrize("vacuum", [0, 6])
@pytest.mark.parametrize("mode", ["transmission", "linear"])
@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_thickness_that_a_section_gains_is_no_drift_of_the_beam(drift, mode, vacuum):
    series = section(mode, vacuum)
    beam = np.exp(drift * np.random.default_rng(2).normal(size=series.num_tilts)).astype(np.float32)
    found = screen(replace(series, images=series.images * beam[:, None, None]))
    assert found.beam_drifts == (drift > 0)
    assert not (found.bad | found.suspect).any()
    assert np.std(np.log(found.beam / beam)) < 0.04


def test_beam_of_a_quiet_needle_that_is_tilted_to_its_edge_is_steady():
    assert screen(load()).drift < 0.01


@pytest.mark.filterwarnings("error:the contrast looks inverted")
@pytest.mark.filterwarnings("ignore:1 of 41 tilts do not fit")
@pytest.mark.parametrize("phantom", ["shells", "particles", "filaments"])
def test_one_black_frame_does_not_invert_the_contrast(phantom):
    _, clean, noisy = scene("clipped", phantom)
    prepared = prepare(noisy(changed(clean, 7, DAMAGES["dark"])))
    assert prepared.tilt_series.num_tilts == len(ANGLES) - 1
    assert "contrast" not in prepared.guard.not_tested


@pytest.mark.parametrize("noise", ["clipped", "low-dose"])
@pytest.mark.parametrize("tilt", [0, -1])
def test_a_dark_frame_at_the_end_is_left_out(noise, tilt):
    """A volume follows the last image, which no others surround, so that its residuals do not show it."""
    _, clean, noisy = scene(noise)
    noisy = noisy(clean)
    dark = np.random.default_rng(0).normal(0, 0.03 * np.ptp(clean.images), clean.images[0].shape).clip(0)
    series = changed(noisy, tilt, lambda images: dark + (images.min() if noise == "low-dose" else 0))
    found = screen(series)
    assert np.flatnonzero(found.bad).tolist() == [tilt % len(ANGLES)]
    assert mode_of_good_tilts(series) == clean.mode


@pytest.mark.parametrize(("phantom", "noise"), [("cell", "clipped"), ("slab", "gaussian"), ("particles", "low-dose")])
@pytest.mark.parametrize("black", [False, True])
def test_mode_is_that_of_the_tilts_without_a_black_frame(phantom, noise, black):
    density = make_phantom(phantom, 32, generator=np.random.default_rng(1))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 6.0), acquisition=ACQUISITIONS[noise])
    series = add_noise(clean, ACQUISITIONS[noise].noise(), seed=1)
    series = changed(series, 10, lambda images: np.zeros_like(images[0])) if black else series
    assert mode_of_good_tilts(replace(series, mode="transmission")) == clean.mode


@pytest.mark.slow
def test_reconstruction_with_the_beam_is_nearly_as_good_as_without_drift():
    truth, clean, noisy = scene("gaussian", size=32)
    beam = np.exp(0.2 * np.random.default_rng(2).normal(size=len(ANGLES)))
    drifting = noisy(replace(clean, images=(clean.images * beam[:, None, None]).astype(np.float32)))
    passed = screen(drifting).passed(drifting)
    psnr = {}
    for name, series in {"steady": noisy(clean), "known": passed, "unknown": drifting}.items():
        # with everything chosen: at a weight of 0.5, which is too low, noise costs as much as the drift
        psnr[name] = compare(JointReconstructor()(series).volume.attenuation, truth).psnr
    assert psnr["known"] > psnr["steady"] - 0.3
    assert psnr["known"] > psnr["unknown"] + 0.3


def test_linear_response_learns_the_beam_up_to_its_mean():
    beam = torch.tensor([0.8, 1.0, 1.25])
    response = Linear(2.0, offset=1.0, beam=beam)
    rays = torch.rand(3, 4, 5)
    torch.testing.assert_close(response.invert(response(rays)), rays)
    torch.testing.assert_close(response(rays), 2 * beam[:, None, None] * rays + 1)
    torch.testing.assert_close(Linear(2.0, offset=1.0, beam=3 * beam)(rays), response(rays))


def test_intensity_and_offset_of_every_tilt_are_in_the_report(tmp_path):
    response = Linear(2.0, offset=torch.tensor([1.0, 3.0]), beam=torch.tensor([0.5, 2.0]))
    assert response.per_tilt(2) == {"relative intensity": pytest.approx([0.5, 2.0]), "offset": [1.0, 3.0]}
    assert Transmission(4.0, offset=1.0).per_tilt(2) == {"intensity": pytest.approx([4.0, 4.0]), "offset": [1.0, 1.0]}
    _, clean, _ = scene(size=16)
    volume = Volume(np.zeros((16, 16, 16), np.float32))
    projector = SliceProjector(tilt_angles=clean.tilt_angles, depth=4, width=4)
    for intensity, found in ((torch.ones(clean.num_tilts), False), (torch.linspace(1, 2, clean.num_tilts), True)):
        model = TomographySignal(VoxelField((4, 16, 4)), projector, Transmission(intensity))
        outcome = Reconstruction(volume, clean.images, "l2", signal_model=model)
        page = reconstruction_report(clean, outcome, []).save(tmp_path / "page.html")
        assert ("Beam and detector" in page.read_text(encoding="utf-8")) is found


def test_command_leaves_the_tilt_out_and_says_so(tmp_path, run):
    _, clean, noisy = scene(size=32)
    series = noisy(changed(clean, 7, DAMAGES["shifted"]))
    np.save(tmp_path / "tilts.npy", series.images)
    np.savetxt(tmp_path / "tilts.tlt", ANGLES)
    command = ["reconstruct", tmp_path / "tilts.npy", "-o", tmp_path / "volume.npy", "--method", "wbp"]
    result = run(*command, "--report", tmp_path / "report")
    assert any("-39°" in warning for warning in result["warnings"])
    assert result["choices"]["tilts left out"] == "1"
    assert [i for i, bad in enumerate(result["screening"]["bad"]) if bad] == [7]
    assert "tilts left out" in (tmp_path / "report" / "index.html").read_text()
    kept = run(*command, "--keep-tilts")
    assert any("kept" in warning for warning in kept["warnings"])
    assert kept["figures"]["tilts"].startswith("41")


def test_a_series_of_mostly_blank_images_is_refused_with_their_number():
    images = np.zeros((13, 12, 12), np.float32)
    images[4:6] = np.random.default_rng(0).random((2, 12, 12))
    with pytest.raises(ValueError, match="11 of 13 images are blank"):
        prepare(TiltSeries(images, np.linspace(-60, 60, 13), mode="linear"))


@pytest.mark.parametrize(
    ("scene", "noise", "tilts", "seed"),
    [
        ("smooth_blobs", "Poisson 2", "±60°/2°", 909),
        ("beads", "detector blur", "0…177°/3°", 905),
        ("off_axis", "detector blur", "0…177°/3°", 908),
    ],
)
def test_single_counts_in_empty_parts_make_no_tilt_inconsistent(scene, noise, tilts, seed):
    found = screen(independent_series(scene, noise, tilts, size=32, seed=seed).series)
    assert not (found.bad | found.suspect).any()


@pytest.mark.parametrize("scene", ["core_shell", "fibres", "off_axis", "text"])
def test_misfit_of_images_without_noise_makes_no_tilt_inconsistent(scene):
    made = independent_series(scene, "Poisson 100", "0…177°/3°", size=32, seed=3)
    found = screen(replace(made.series, images=np.exp(-made.clean / made.clean.max()), mode="transmission"))
    assert not (found.bad | found.suspect).any()


@pytest.mark.parametrize("noise", ["Poisson 10", "Poisson 40, read noise"])
@pytest.mark.parametrize("scene", ["core_shell", "needle_with_precipitates"])
def test_hot_pixels_are_no_drift_of_the_beam(scene, noise):
    series = independent_series(scene, noise, "±60°/2°", size=32, seed=3).series
    hot = np.random.default_rng(0).random(series.images.shape) < 0.002
    found = screen(replace(series, images=np.where(hot, 12.0 * series.images.max(), series.images)))
    assert not found.beam_drifts


@pytest.mark.parametrize("scene", ["beads", "fibres", "off_axis"])
def test_a_frame_twice_too_bright_does_not_hide_the_mode(scene):
    made = independent_series(scene, "Poisson 100", np.arange(0, 360, 10.0), size=32, seed=3)
    images = np.exp(-made.clean / made.clean.max())
    images[12] *= 2
    assert mode_of_good_tilts(replace(made.series, images=images)) == "transmission"


def test_images_that_no_beam_can_have_made_are_linear():
    images = np.zeros((25, 24, 24), np.float32)
    images[:, 12, 10:14] = 1.0
    assert mode_of_good_tilts(TiltSeries(images, np.arange(-60, 61, 5.0))) == "linear"


@pytest.mark.parametrize("drift", [0.0, 0.2])
@pytest.mark.parametrize(("scene", "tilts"), [("beads", "0…177°/3°"), ("text", "±60°/2°"), ("off_axis", "±70°/5°")])
def test_few_counts_are_no_drift_and_hide_none(scene, tilts, drift):
    made, random = independent_series(scene, "Poisson 10", tilts, size=32, seed=3), np.random.default_rng(1)
    beam = np.exp(drift * random.normal(size=made.series.num_tilts))
    images = random.poisson(10 * made.clean / made.clean.max() * beam[:, None, None])
    assert screen(replace(made.series, images=images.astype(np.float32))).beam_drifts == (drift > 0)


@pytest.mark.parametrize("scene", ["beads", "fibres", "text"])
def test_noise_in_columns_is_no_drift_of_the_beam(scene):
    series, random = (
        independent_series(scene, "Poisson 100", "±60°/2°", size=32, seed=3).series,
        np.random.default_rng(0),
    )
    images = series.images.astype(np.float32)
    images[:, :, [7, 18, 25]] = random.uniform(images.min(), images.max(), (len(images), 32, 3))
    assert not screen(replace(series, images=images)).beam_drifts


@pytest.mark.parametrize(("noise", "tilts"), [("Poisson 2", "±60°/2°"), ("8 bits, gamma", "±50°/10°")])
def test_what_low_tilts_cut_off_is_no_drift_of_the_beam(noise, tilts):
    assert not screen(independent_series("truncated_object", noise, tilts).series).beam_drifts


@pytest.mark.parametrize("scene", ["beads", "off_axis", "text"])
def test_noise_takes_no_small_object_to_the_sides(scene):
    """The emptiest columns of noise are below its mean."""
    assert not beyond_sides(coarse(independent_series(scene, "outliers", "±60°/2°", seed=3).series))


@pytest.mark.parametrize("scene", ["core_shell", "beads"])
def test_hot_pixels_do_not_hide_the_mode(scene):
    made = independent_series(scene, "Poisson 100", "±60°/2°", size=32, seed=3)
    images = np.exp(-made.clean / made.clean.max())
    hot = np.random.default_rng(0).random(images.shape) < 0.002
    assert mode_of_good_tilts(replace(made.series, images=np.where(hot, 12.0, images))) == "transmission"
