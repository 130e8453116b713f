"""What the moments of the rows require, of blobs whose projections are known exactly."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from noiseflow.checks import LIKELY, Effect, NotTested
from recon.series.alignment import Alignment
from recon.series.tilt_series import TiltSeries
from recon.verdict.case import Case
from recon.verdict.compared import Coarse, Residuals
from recon.verdict.moments import Violations, as_of_dark_field, violations
from recon.verdict.table import CHECKS
from recon.verdict.tilts import smoothest_order

ROWS = WIDTH = 32


def blobs(
    angles: Any,
    *,
    direction: float = 0.0,
    turn: float = 0.0,
    offset: float = 0.0,
    scale: float = 1.0,
    rows: int = ROWS,
    noise: float = 0.0,
) -> Coarse:
    """Images of Gaussian blobs, from an axis in another direction (degrees), or another place (pixels)."""
    random = np.random.default_rng(0)
    z, y, x = random.uniform(-8, 8, (3, 40))
    theta = np.deg2rad(angles * scale)[:, None]
    phi = np.deg2rad(direction + turn * np.linspace(-0.5, 0.5, len(angles)))[:, None]
    across = x * np.cos(theta) + z * np.sin(theta)
    shown_y, shown_u = y * np.cos(phi) + across * np.sin(phi), across * np.cos(phi) - y * np.sin(phi) + offset
    place = [np.arange(size) - (size - 1) / 2 for size in (rows, WIDTH)]
    spread = [np.exp(-((p - shown[..., None]) ** 2) / 4) for p, shown in zip(place, (shown_y, shown_u), strict=True)]
    images = np.einsum("tby,tbu->tyu", *spread) + noise * random.normal(size=(len(angles), rows, WIDTH))
    return Coarse(images, np.ones(images.shape, bool), angles, np.arange(len(angles)), 2, WIDTH, WIDTH, 0.0)


def found_in(series: Coarse, fitted: Any) -> Violations:
    """The violations, where a fit of any of the images is known."""
    noise = np.random.default_rng(2).normal(size=(4, *fitted.shape))
    return violations(series, series.images, lambda _: fitted, ((fitted + each, fitted) for each in 0.05 * noise))


@pytest.mark.parametrize("angles", [np.arange(-60.0, 61, 3), np.arange(0.0, 178, 4)], ids=["wedge", "full"])
@pytest.mark.parametrize(
    ("wrong", "part", "expected"),
    [
        ({"direction": 3.0}, "direction", 3.0),
        ({"direction": 20.0}, "direction", 20.0),
        ({"turn": 6.0}, "turn", 6.0),
        ({"offset": 1.0}, "offset", 2.0),
        ({"scale": 0.9}, "scale", -0.1),
    ],
)
def test_a_wrong_axis_is_measured_within_its_error(angles: Any, wrong: Any, part: str, expected: float) -> None:
    right, series = (blobs(angles, noise=0.05, **each) for each in ({}, wrong))
    found = getattr(found_in(series, blobs(angles).images), part)  # a fit has the given geometry
    assert found.value == pytest.approx(expected, rel=0.2)
    assert abs(found.value) > 4 * found.error > 0
    assert abs(getattr(found_in(right, blobs(angles).images), part).value) < 0.1 * abs(expected)


@pytest.mark.parametrize("direction", [-5.0, 5.0])
def test_the_axis_that_the_verdict_names_is_the_one_to_give(direction: float) -> None:
    angles = np.arange(-60.0, 61, 3)
    right, wrong = blobs(angles), blobs(angles, direction=direction)
    raw = TiltSeries(wrong.images, angles, mode="linear")
    for applied in (0.0, 2.0):
        alignment = Alignment.unshifted(raw, applied)
        images = np.asarray(alignment.apply(raw).images)
        found = found_in(replace(wrong, images=images), right.images)
        case = SimpleNamespace(moments=found, alignment=alignment if applied else None)
        sentence = CHECKS["tilt axis"].finding(case).sentence
        by, to = (float(each) for each in re.findall(r"[-+]?\d+\.\d", sentence))
        assert by == pytest.approx(direction - applied, abs=0.5)
        assert to == pytest.approx(direction, abs=0.5)
    aligned = Alignment.unshifted(raw, to).apply(raw).images
    assert np.std(aligned - right.images) < 0.3 * np.std(raw.images - right.images)


def test_few_rows_are_not_tested() -> None:
    series = blobs(np.arange(-60.0, 61, 3), rows=8)
    with pytest.raises(NotTested, match="rows"):
        found_in(series, series.images)


def test_shuffled_images_are_put_in_order() -> None:
    images = blobs(np.arange(-60.0, 61, 3)).images
    mixed = np.random.default_rng(1).permutation(len(images))
    order = mixed[smoothest_order(images[mixed])]
    assert list(order if order[0] < order[-1] else order[::-1]) == list(range(len(images)))


@pytest.mark.parametrize("angles", [np.arange(-60.0, 61, 3), np.arange(0.0, 178, 4)], ids=["wedge", "full"])
def test_a_response_that_loses_signal_is_measured(angles: Any) -> None:
    clean = blobs(angles).images
    strongest, noise = np.quantile(clean, 0.99), 0.05 * np.random.default_rng(1).normal(size=clean.shape)
    for lost in (0.0, 0.2):
        bent = clean - lost / strongest * clean**2
        found = found_in(replace(blobs(angles), images=bent + noise), clean).response
        assert found.value == pytest.approx(lost, abs=0.03)
        assert (found.value > 4 * found.error) == (lost > 0)


def test_half_a_percent_of_brightness_on_a_round_object_is_no_response() -> None:
    angles = np.arange(-70.0, 71, 2)
    theta, place = np.deg2rad(angles)[:, None, None], np.arange(WIDTH) - (WIDTH - 1) / 2
    width = 4 + 0.1 * np.cos(2 * theta)  # the squares vary by one percent over the tilts
    images = np.linspace(0.5, 1, ROWS)[:, None] * np.exp(-(place**2) / 2 / width**2) / width
    series = replace(blobs(angles), images=images)
    brighter = replace(series, images=images * (1 + 0.005 * np.cos(2 * theta)))
    noise = 0.002 * np.random.default_rng(2).normal(size=(4, *images.shape))
    found = violations(
        brighter, brighter.images, lambda _: images, ((images + each, images) for each in noise)
    ).response
    assert abs(found.value) > 0.15  # it would be a fault if it were certain
    assert abs(found.value) < LIKELY * found.error


@pytest.mark.parametrize("inverted", [False, True])
def test_inverted_dark_field_keeps_another_mass_than_bright_field(inverted: bool) -> None:
    """Also where the beam changes, and where a part of the specimen leaves the images, as the fit knows."""
    angles, random = np.arange(-60.0, 61, 3), np.random.default_rng(1)
    lines = blobs(angles).images
    lines /= lines.max()
    left = 0.2 * (np.arange(WIDTH) > WIDTH / 2) * np.sin(np.deg2rad(3 * angles))[:, None, None]
    for gone in (0, 0 if inverted else left):
        shown = lines * (1 - gone)
        dark = 1 - 0.85 * shown
        fitted = np.exp(shown * (shown * np.log(dark)).sum() / (shown**2).sum())
        change = (np.exp(-shown) - 1 + shown).sum((1, 2), keepdims=True)  # as the mass of dark field changes
        beam = 1 - 0.05 * (change - change.mean()) / change.std()
        images = (dark if inverted else fitted * beam) + 0.005 * random.normal(size=lines.shape)
        series = TiltSeries(images, angles)
        found = CHECKS["inverted dark field"].of(as_of_dark_field(series, Residuals.of(series, fitted), None), 0.5)
        assert (found.cost > 1) == inverted, found


@pytest.mark.parametrize(("jitter", "named"), [(0.0, False), (0.05, False), (0.2, True)])
def test_level_of_the_vacuum_is_measured_beside_its_noise(jitter: float, named: bool) -> None:
    angles, random = np.arange(-60.0, 61, 3), np.random.default_rng(1)
    lines = blobs(angles).images
    left = jitter * lines.mean() * random.normal(size=(len(angles), 1, 1)) + random.normal(size=lines.shape)
    series = TiltSeries(lines + left + 300, angles, mode="linear")
    case: Any = Case(series, SimpleNamespace(projections=lines + 300, volume=None))  # type: ignore[arg-type]
    found = CHECKS["level of the vacuum"].finding(case)
    assert found.effect.value == pytest.approx(jitter, abs=0.04)
    assert (found.cost > 1) == named, found


def test_fewer_violations_than_replicates_have_are_no_fault():
    case = SimpleNamespace(moments=SimpleNamespace(power=Effect(-0.0084, 0.002)))
    assert CHECKS["moments of the rows"].finding(case).cost == 0
