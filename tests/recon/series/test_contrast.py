"""The mode of a series, as its images decide it."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

import recon
from recon.projection.image_formation import Linear, Transmission
from recon.series.first_guess import (
    behind_section,
    check_contrast,
    estimate_response,
    likely_mode,
    scale_by_section,
    widened,
)
from recon.series.tilt_series import Mode
from recon.simulate.simulation import Acquisition


def section(mode: Mode, vacuum: int, width: int = 24, own: float = 0.0) -> recon.TiltSeries:
    """A section with bubbles that goes on beyond the images, but for `vacuum` pixels at one side at zero tilt, and lies off the
    stage by its `own` tilt."""
    generator = np.random.default_rng(0)
    rough = gaussian_filter(generator.normal(size=(width // 4, width, 5 * width)), 1.5, mode="wrap")
    density = 1.0 * (rough < 1.5 * rough.std())
    density[:, :, : 2 * width + vacuum if vacuum else 0] = 0
    angles = np.arange(-60, 61, 4.0)
    projector = recon.SliceProjector(tilt_angles=angles - own, depth=len(density), width=density.shape[2])
    lines = projector(torch.from_numpy(density).float()).numpy()[:, :, 2 * width : 3 * width] / len(density)
    counts = generator.poisson(100 * (np.exp(-lines) if mode == "transmission" else lines))
    return recon.TiltSeries(counts.astype(np.float32), angles, mode=mode)


@pytest.mark.parametrize("mode", ["transmission", "linear"])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_mode_is_that_of_the_images(mode: str, noise: float) -> None:
    density = np.zeros((24, 24, 24))
    density[8:14, 6:18, 9:17] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0), acquisition=Acquisition(None, mode))
    images = series.images + noise * series.images.std() * np.random.default_rng(0).normal(size=series.images.shape)
    other = recon.TiltSeries(images.astype(np.float32), series.tilt_angles)
    assert likely_mode(other) == mode


@pytest.mark.parametrize("mode", ["transmission", "linear"])
def test_exposures_that_grow_with_the_tilt_do_not_change_the_mode(mode: Mode) -> None:
    density = np.zeros((24, 24, 24))
    density[8:14, 6:18, 9:17] = 0.03
    angles = np.arange(-60, 61, 5.0)
    series, _ = recon.clean_tilt_series(density, angles, acquisition=Acquisition(None, mode))
    share = 0.8 + 0.2 * series.images if mode == "transmission" else series.images
    counts = np.random.default_rng(0).poisson(400 * share / np.cos(np.deg2rad(angles))[:, None, None])
    assert likely_mode(recon.TiltSeries(counts, angles)) == mode


@pytest.mark.parametrize("counts", [0.05, 0.5, 2.0])
def test_maps_of_few_counts_have_a_dark_background(counts: float) -> None:
    density = np.zeros((24, 24, 24))
    density[8:14, 6:18, 9:17] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0), acquisition=Acquisition(None, "linear"))
    images = np.random.default_rng(0).poisson(counts * series.images / series.images.max()).astype(np.float32)
    assert likely_mode(recon.TiltSeries(images, series.tilt_angles)) == "linear"


def test_images_of_noise_have_no_mode() -> None:
    images = np.random.default_rng(0).normal(100.0, 1.0, (25, 24, 24)).astype(np.float32)
    assert likely_mode(recon.TiltSeries(images, np.arange(-60, 61, 5.0))) is None


@pytest.mark.parametrize("vacuum", [0, 6])
@pytest.mark.parametrize("mode", ["transmission", "linear"])
def test_sections_beyond_the_field_of_view_have_the_mode_of_their_images(mode: Mode, vacuum: int) -> None:
    series = section(mode, vacuum)
    assert likely_mode(replace(series, mode="linear" if mode == "transmission" else "transmission")) == mode
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_contrast(series)


@pytest.mark.parametrize("own", [0.0, 12.0])
def test_level_of_vacuum_behind_a_section(own: float) -> None:
    """Incident intensity of bright field, and dark level of linear images, where no pixel shows them; fits hold both."""
    bright = estimate_response(section("transmission", 0, own=own))
    assert isinstance(bright, Transmission)
    assert float(bright.intensity) == pytest.approx(100, rel=0.03)
    linear = section("linear", 0, own=own)
    dark = estimate_response(replace(linear, images=linear.images + 30))
    assert isinstance(dark, Linear)
    assert float(dark.offset) == pytest.approx(30, abs=0.03 * float(np.median(linear.images)))
    assert not bright.vacuum.requires_grad
    assert not dark.vacuum.requires_grad
    assert estimate_response(section("linear", vacuum=6)).vacuum.requires_grad


@pytest.mark.parametrize("mode", ["transmission", "linear"])
def test_padding_beside_a_section_does_not_move_its_vacuum(mode: Mode) -> None:
    """Screening compares images that are padded to three widths."""
    series = section(mode, 0, own=12.0)
    assert behind_section(widened(series)) == pytest.approx(behind_section(series), rel=1e-5)


@pytest.mark.parametrize("mode", ["transmission", "linear"])
@pytest.mark.parametrize("own", [0.0, 12.0])
@pytest.mark.parametrize("factor", [0.85, 1.0, 1.3])
def test_thickness_of_a_section_tells_the_scale_of_the_angles(mode: Mode, own: float, factor: float) -> None:
    series = section(mode, 0, own=own)
    scale, error = scale_by_section(replace(series, tilt_angles=factor * series.tilt_angles))
    assert error < 0.05
    assert abs(scale * factor - 1) < 3 * error


def test_a_beam_that_changes_is_no_thickness() -> None:
    for mode in ("transmission", "linear"):
        series = section(mode, 0)
        beam = np.random.default_rng(0).uniform(0.5, 2, series.num_tilts)
        images = series.images * beam[:, None, None].astype(np.float32)
        level = behind_section(replace(series, images=images, beam=beam))
        known = behind_section(series)
        assert level is not None
        assert known is not None
        assert abs(level - known) < 0.05 * np.ptp(series.images), (mode, level, known)


@pytest.mark.parametrize("mode", ["transmission", "linear"])
def test_vacuum_in_the_images_needs_no_section(mode: Mode) -> None:
    assert behind_section(section(mode, vacuum=6)) is None
