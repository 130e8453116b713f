"""Vacuum in the images, which fixes the offset and the beam."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import recon
from noiseflow import Digitised, Gaussian, Poisson
from recon.joint.task import Task
from recon.joint.vacuum import vacuum_level, vacuum_pixels
from recon.projection.base import to_columns
from tests.independent_scenes import Array, Noise, ball, clean_and_truth, independent_series, poisson, scan_noise

_TILTS, _SIZE = 30, 24


def _task(response: recon.Linear | recon.Transmission, *, haze: float, film: float) -> Task:
    """A volume of a block within a haze, whose images show the block and a film in place of the haze."""
    projector = recon.SliceProjector(tilt_angles=np.linspace(-60, 60, _TILTS), depth=_SIZE, width=_SIZE)
    field = recon.VoxelField((_SIZE, _SIZE, _SIZE), scale=1.0)
    volume = torch.full((_SIZE, _SIZE, _SIZE), haze)
    volume[9:15, 9:15, 9:15] = 1
    field.start_from(volume)
    shown = torch.full_like(volume, film)
    shown[9:15, 9:15, 9:15] = 1
    with torch.no_grad():
        clean = response(projector.project(to_columns(shown)).view(_TILTS, _SIZE, _SIZE))
    images = clean + 0.02 * clean.mean() * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return Task(
        recon.TomographySignal(field, projector, response), images, None, torch.zeros(clean.shape, dtype=torch.bool)
    )


@pytest.mark.parametrize(
    "response", [recon.Linear(gain=3.0, offset=5.0), recon.Transmission(intensity=100.0)], ids=repr
)
@pytest.mark.parametrize("haze", [0.02, 0.1])
def test_rays_beside_the_object_are_vacuum_if_images_do_not_show_the_haze_of_the_volume(
    response: recon.Linear | recon.Transmission, haze: float
) -> None:
    task = _task(response, haze=haze, film=0)
    clear = vacuum_pixels(task, least=0.15)
    assert clear is not None
    assert 0.2 < clear.float().mean() < 0.8
    level = vacuum_level(Gaussian(), task.observation[clear], torch.ones(int(clear.sum())))
    assert level is not None
    assert level == pytest.approx(float(response(torch.zeros(1, 1, 1)).detach()), rel=0.01)


@pytest.mark.parametrize(
    "response", [recon.Linear(gain=3.0, offset=5.0), recon.Transmission(intensity=100.0)], ids=repr
)
@pytest.mark.parametrize("haze", [0.02, 0.1])
def test_a_haze_that_images_show_is_no_vacuum(response: recon.Linear | recon.Transmission, haze: float) -> None:
    assert vacuum_pixels(_task(response, haze=haze, film=haze), least=0.15) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_an_object_that_fills_the_field_leaves_the_level_of_vacuum_known(seed: int) -> None:
    """The first volume has a haze of more than it has vacuum, and a lower level makes room for it: by 10 counts of 300."""

    def body(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
        found = 0.35 * ((x / 0.84) ** 2 + (y / 0.84) ** 2 + (z / 0.67) ** 2 < 1)
        for _ in range(14):
            found[ball(x, y, z, random.uniform(-0.4, 0.4, 3), random.uniform(0.08, 0.22))] = random.uniform(0.1, 1.3)
        return found

    angles, random = np.arange(-60, 61, 3.0), np.random.default_rng(seed)
    clean, truth = clean_and_truth(body, angles, 32, seed)
    images = random.normal(300 + 50 * clean, np.sqrt(100 * clean + 100)).astype(np.float32)
    found = recon.reconstruct(recon.TiltSeries(images, angles, mode="linear"))
    assert found.volume.attenuation.sum() == pytest.approx(50 * truth.sum(), rel=0.02)
    assert float(found.choices["offset"]) == pytest.approx(300, abs=1)


def test_offsets_that_are_given_are_not_held() -> None:
    assert vacuum_pixels(_task(recon.Linear(gain=3.0, estimate=False), haze=0.02, film=0), least=0.15) is None


@pytest.mark.parametrize("haze", [0.02, 0.1])
def test_beams_of_every_tilt_hide_neither_vacuum_nor_a_film(haze: float) -> None:
    beams = 100 * torch.exp(0.2 * torch.randn(_TILTS, generator=torch.Generator().manual_seed(0)))
    for film in (0.0, haze):
        task = _task(response := recon.Transmission(beams), haze=haze, film=film)
        clear = vacuum_pixels(task, least=0.15)
        assert (clear is None) == (film > 0)
        if clear is not None:
            units = response.vacuum_ratios.expand_as(clear)[clear]
            level = vacuum_level(Gaussian(), task.observation[clear], units)
            assert level == pytest.approx(float(beams.log().mean().exp()), rel=0.01)


def test_a_fit_changes_the_beams_of_all_tilts_by_one_factor() -> None:
    beams = torch.tensor([80.0, 100.0, 125.0])
    response = recon.Transmission(beams)
    response(torch.zeros(3, 1, 1))[0].sum().backward()
    slopes = response.log_intensity.grad
    assert slopes is not None
    torch.testing.assert_close(slopes, slopes.mean().expand_as(slopes))
    assert float(slopes.sum()) == pytest.approx(80)
    response.set_vacuum(50)
    torch.testing.assert_close(response.intensity, beams / 2)


@pytest.mark.slow
def test_beams_of_every_tilt_leave_the_mass_of_a_film_known() -> None:
    """Fitted one by one, beams made room for a haze: the mass was 1.16."""

    def film(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
        return np.where((np.abs(z) < 0.1) & (np.abs(x) < 0.8) & (np.abs(y) < 2), 0.3, 0.0)

    angles, random = np.arange(-60, 61, 3.0), np.random.default_rng(102)
    clean, truth = clean_and_truth(film, angles, 32, 2)
    beams = 100 * np.exp(0.03 * random.standard_normal(len(angles)))[:, None, None]
    images = random.poisson(beams * np.exp(-0.5 * clean / clean.max())).astype(np.float32)
    prepared = recon.prepare(recon.TiltSeries(images, angles, mode="transmission"))
    found = recon.reconstruct(prepared.tilt_series)
    assert found.volume.attenuation.sum() == pytest.approx(0.5 / clean.max() * truth.sum(), rel=0.05)


def test_few_pixels_are_no_vacuum() -> None:
    task = _task(recon.Linear(gain=3.0), haze=0.02, film=0)
    task.held_out[:, :, 1:] = task.held_out[:, 12:] = True
    assert int(task.train.sum()) < 400
    assert vacuum_pixels(task, least=0.15) is None


@pytest.mark.parametrize("response", [recon.Linear(gain=3.0), recon.Transmission(100.0, offset=5.0)], ids=repr)
def test_the_signal_without_an_object_is_the_level_that_is_set(response: recon.Linear | recon.Transmission) -> None:
    response.set_vacuum(7.0)
    torch.testing.assert_close(response(torch.zeros(1, 1, 1)).detach(), torch.full((1, 1, 1), 7.0))


def _clipped(level: float, size: int = 50_000) -> Tensor:
    drawn = level + 3 * torch.randn(size, generator=torch.Generator().manual_seed(1))
    return drawn.round().clamp(min=0)


def test_level_of_clipped_pixels_is_that_before_clipping() -> None:
    pixels = _clipped(2.0)
    assert float(pixels.mean()) > 2.3
    assert vacuum_level(Digitised(Gaussian(3.0), low=0), pixels, torch.ones_like(pixels)) == pytest.approx(
        2.0, abs=0.05
    )


def test_pixels_that_are_all_clipped_do_not_determine_a_level() -> None:
    for model, pixels in (
        (Digitised(Gaussian(3.0), low=0), _clipped(-100.0)),
        (Digitised(Gaussian(3.0), low=0), _clipped(-6.0)),
        (Poisson(), torch.zeros(1000)),
    ):
        assert vacuum_level(model, pixels, torch.ones_like(pixels), lowest=0.0) is None


@pytest.mark.parametrize(
    ("scene", "noise", "tilts", "offset"),
    # free fits end at 9.3, 9.5 and 18.9, with masses of 1.10, 1.06 and 1.07
    [
        ("gyroid", poisson(40, offset=10, read_noise=2), "±50°/10°", 10),
        pytest.param("tilted_slab", poisson(40, offset=10, read_noise=2), "0…177°/3°", 10, marks=pytest.mark.slow),
        pytest.param("gyroid", scan_noise, "0…177°/3°", 20, marks=pytest.mark.slow),
    ],
)
def test_no_haze_takes_the_place_of_the_offset(scene: str, noise: Noise, tilts: str, offset: float) -> None:
    made = independent_series(scene, noise, tilts)
    found = recon.reconstruct(made.series)
    assert found.signal_model.response()["offset"][0] == pytest.approx(offset, rel=0.01)
    assert found.volume.attenuation.sum() == pytest.approx(made.truth.sum(), rel=0.02)


@pytest.mark.slow
def test_a_film_of_a_fifth_of_a_count_is_kept() -> None:
    made = independent_series("faceted_particle_on_film", poisson(10), "±70°/5°")
    # as vacuum, the film went into an offset of 0.2 counts, and the mass was 0.85
    assert recon.reconstruct(made.series).volume.attenuation.sum() > 0.94 * made.truth.sum()


@pytest.mark.slow
def test_bright_discs_do_not_lift_the_counts_of_a_faint_background() -> None:
    across, angles, along = np.arange(96) - 47.5, np.arange(-60, 61, 2.0), 1 + 0.3 * np.cos(np.arange(12) / 4)
    clean = np.zeros((len(angles), 12, 96))
    for z, x, radius, density in ((10, -20, 9, 1.0), (-15, 5, 14, 0.6), (20, 18, 6, 1.4), (-5, -30, 4, 2.0)):
        centre = x * np.cos(np.deg2rad(angles)) + z * np.sin(np.deg2rad(angles))
        chord = 2 * np.sqrt(np.clip(radius**2 - (across - centre[:, None]) ** 2, 0, None))
        clean += density * chord[:, None, :] * along[:, None]
    images = np.random.default_rng(5).poisson(60 / clean.max() * clean + 0.5).astype(np.uint16)
    found = recon.reconstruct(recon.TiltSeries(images, angles, mode="linear"))
    # least squares ends at 0.99 before the noise is chosen, and counts then began at 0.5: the mass was 0.976
    assert found.signal_model.response()["offset"][0] == pytest.approx(0.5, abs=0.05)
