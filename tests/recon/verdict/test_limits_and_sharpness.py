"""What a detector or a number type cut off, and tilts more blurred than others, are named; good series of all kinds are not."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.sabotage import spoil
from benchmarks.scenes import Scene, make_scene
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.verdict import tilts
from recon.verdict.coarse import coarse_series
from recon.verdict.judge import PIXELS
from recon.verdict.limits import cliff, saturation
from recon.verdict.residuals import Residuals
from recon.verdict.sharpness import blurs, sharpness_findings

NAMES = ("half of the tilts out of focus", "blur that grows with the tilt")


def scene(phantom: str, noise: str, seed: int = 0) -> Scene:
    return make_scene(48, phantom=phantom, noise=noise, tilts="-60:60:3", seed=seed)


def spoilt(phantom: str, noise: str, name: str) -> TiltSeries:
    return spoil(scene(phantom, noise), name, other=scene(phantom, noise, 9), seed=5).series


def residuals(series: TiltSeries, clean: Any) -> Residuals:
    return Residuals.of(series, clean.astype(np.float32))


def pixel_part(series: TiltSeries, left: Residuals) -> tuple[dict[str, Any], list[Any]]:
    """Evidence and findings of all checks of pixel values."""
    parts = [check(series, left.images, left) for check in PIXELS.values()]
    return {name: value for part, _ in parts for name, value in part.items()}, [
        each for _, found in parts for each in found
    ]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
def test_tilts_more_blurred_than_others_are_named(phantom: str, noise: str, name: str) -> None:
    series = spoilt(phantom, noise, name)
    _, findings = sharpness_findings(series, residuals(series, series.images))
    assert {finding.subject for finding in findings} == {"resolution"}


@pytest.mark.parametrize("noise", ["clipped", "low-dose", "8-bit", "outliers"])
@pytest.mark.parametrize("phantom", ["shells", "filaments", "slab", "atoms"])
def test_good_series_are_neither_blurred_nor_cut_off(phantom: str, noise: str) -> None:
    made = scene(phantom, noise, seed=2)
    left = residuals(made.noisy, made.clean.images)
    for check in (saturation, cliff):
        assert check(made.noisy, left.images, left)[1] == []
    assert sharpness_findings(made.noisy, left)[1] == []


def test_a_mask_keeps_what_it_hides_from_looking_blurred() -> None:
    made = scene("particles", "low-dose")
    images, mask = made.noisy.images.copy(), np.ones(made.noisy.images.shape, dtype=bool)
    mask[20:, 4:44, 4:44] = False
    images[~mask] = images.mean()
    series = TiltSeries(images, made.noisy.tilt_angles, mode="linear", mask=mask)
    assert sharpness_findings(series, residuals(series, made.clean.images))[1] == []
    bare = TiltSeries(images, made.noisy.tilt_angles, mode="linear")
    assert sharpness_findings(bare, residuals(bare, made.clean.images))[1] != []


def test_blur_is_measured_in_pixels() -> None:
    y = np.arange(64.0)
    widths = np.linspace(4.0, 5.0, 21)
    bumps = np.exp(-((y - 31.5) ** 2) / (2 * widths[:, None] ** 2)) / widths[:, None]
    values, _ = blurs(np.repeat(bumps[:, :, None], 8, axis=2))
    np.testing.assert_allclose(2 * (values[-1] - values[0]), 5.0**2 - 4.0**2, rtol=0.1)


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
@pytest.mark.parametrize(("name", "check"), [("saturation", saturation), ("overflow of the number type", cliff)])
def test_values_cut_off_or_wrapped_around_are_named(phantom: str, noise: str, name: str, check: Any) -> None:
    series = spoilt(phantom, noise, name)
    left = residuals(series, scene(phantom, noise).clean.images)
    assert [finding.subject for finding in check(series, left.images, left)[1]][:1] == ["saturation"]


def test_few_counts_have_no_pile_at_their_highest() -> None:
    means = 0.3 * scene("particles", "low-dose").clean.images
    counts = np.random.default_rng(0).poisson(means).astype(np.uint8)
    series = TiltSeries(counts, np.arange(-60.0, 61, 3), mode="linear")
    left = residuals(series, means)
    for check in (saturation, cliff):
        assert check(series, left.images, left)[1] == []


def test_halves_of_a_detector_with_another_gain_are_named() -> None:
    made = scene("shells", "clipped")
    series = spoilt("shells", "clipped", "half of the columns with another gain")
    assert "pattern" in {each.subject for each in pixel_part(series, residuals(series, made.clean.images))[1]}
    assert pixel_part(made.noisy, residuals(made.noisy, made.clean.images))[1] == []


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit")]
)
def test_a_dead_region_is_named_until_it_is_masked(phantom: str, noise: str) -> None:
    made = scene(phantom, noise)
    series = spoilt(phantom, noise, "one region black in all images")
    found = pixel_part(series, residuals(series, made.clean.images))[1]
    assert any("have a constant value in all tilts" in each.sentence for each in found)
    masked = replace(series, mask=made.noisy.images == series.images)
    assert pixel_part(masked, residuals(masked, made.clean.images))[0]["dead pixels"] == 0


@pytest.mark.parametrize(
    ("phantom", "noise"), [("shells", "clipped"), ("particles", "low-dose"), ("slab", "8-bit"), ("slab", "low-dose")]
)
def test_vacuum_without_noise_is_not_dead(phantom: str, noise: str) -> None:
    clean = scene(phantom, noise).clean
    assert pixel_part(clean, residuals(clean, clean.images))[0]["dead pixels"] == 0


def test_copies_of_images_raise_no_warning() -> None:
    series = spoilt("particles", "low-dose", "one image repeated over a third of the tilts")
    coarse = coarse_series(series, VolumeGrid.of(series, None))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evidence, _ = tilts.jumps(coarse)
        _, findings = tilts.repeats(series)
    assert np.isfinite(evidence["largest jump"])
    assert "repeats" in {each.subject for each in findings}
