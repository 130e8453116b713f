"""A specimen that shrinks with the dose: measured from its profile along the axis, told in the verdict, and corrected."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.ndimage import affine_transform

import recon
from noiseflow.checks import Guard
from recon.projection.projector import SliceProjector
from recon.series.alignment import Alignment
from recon.series.shrinkage import acquisition_orders, estimate_shrinkage
from recon.series.tilt_series import TiltSeries
from recon.simulate.phantoms import make_phantom
from recon.verdict.case import Case
from recon.verdict.table import CHECKS
from tests.recon.series.test_contrast import section

ANGLES, SIZE, MIDDLE = np.arange(-60, 61, 4.0), 32, 15.5
NAMES = list(acquisition_orders(ANGLES))


def zoomed(volume, scale):
    matrix = np.eye(3) / scale
    return affine_transform(volume, matrix, MIDDLE - matrix @ np.full(3, MIDDLE), order=3)


@cache
def _volume(phantom):
    return make_phantom(phantom, SIZE, generator=np.random.default_rng(0)).astype(np.float64)


@cache  # every order of acquisition passes through the same sizes
def _zoomed(phantom, scale):
    return zoomed(_volume(phantom), scale)


def shrunken(phantom, change, order, noise=0.3):
    """A series of a specimen whose size changes from 1 to 1 + change in the order of acquisition."""
    volume = _volume(phantom)
    dose = np.argsort(np.argsort(acquisition_orders(ANGLES)[order])) / (len(ANGLES) - 1)
    images = []
    for angle, late in zip(ANGLES, dose, strict=True):
        projector = SliceProjector(tilt_angles=[angle], depth=SIZE, width=SIZE, dtype=torch.float64)
        images.append(projector(torch.from_numpy(_zoomed(phantom, 1 + change * late)))[0].numpy())
    stack = np.stack(images)
    stack += np.random.default_rng(1).normal(0, noise * stack.std(), stack.shape)
    return TiltSeries(stack.astype(np.float32), ANGLES, mode="linear"), volume, dose


@pytest.mark.parametrize("order", NAMES)
@pytest.mark.parametrize("phantom", ["shells", "particles", "cell", "catalyst"])
def test_shrinkage_and_its_order_are_found(phantom, order):
    series, _, _ = shrunken(phantom, -0.07, order)
    found = estimate_shrinkage(series)
    assert found.found
    assert found.order == order
    assert found.change == pytest.approx(-0.07, abs=max(0.015, 3 * found.error))


@pytest.mark.parametrize("phantom", ["shells", "particles", "cell", "catalyst", "filaments", "slab"])
def test_a_specimen_that_does_not_change_is_not_accused(phantom):
    series, _, _ = shrunken(phantom, 0.0, "dose-symmetric")
    assert not estimate_shrinkage(series).found


@pytest.mark.parametrize("mode", ["transmission", "linear"])
def test_a_section_that_goes_on_beside_the_images_has_no_size(mode):
    guard = Guard()
    assert guard("shrinkage", lambda: estimate_shrinkage(section(mode, vacuum=0)), otherwise=None) is None
    assert guard.not_tested["shrinkage"].startswith("the specimen goes on beside the images")


def test_a_given_dose_replaces_the_assumptions():
    series, _, dose = shrunken("shells", -0.07, "from zero up, then down")
    told = TiltSeries(series.images, ANGLES, mode="linear", dose=dose * 120)
    assert estimate_shrinkage(told).order == "given"
    assert estimate_shrinkage(told).change == pytest.approx(-0.07, abs=0.02)


@pytest.mark.filterwarnings(
    "ignore:aligned images show:UserWarning"
)  # the alignment moves parts out of the frame on purpose
def test_corrected_images_give_the_volume_of_the_middle_of_the_dose():
    series, volume, _ = shrunken("shells", -0.1, "dose-symmetric", noise=0.1)
    plain = Alignment(0.0, np.zeros((len(ANGLES), 2)), ANGLES)
    corrected = estimate_shrinkage(series).correct(plain).apply(series)
    assert not estimate_shrinkage(corrected).found
    middle = zoomed(volume, 0.95)
    psnr = [
        recon.compare(
            recon.reconstruct(each, method="sirt", num_steps=30).volume.attenuation, middle, scaling="affine"
        ).psnr
        for each in (series, corrected)
    ]
    assert psnr[1] > psnr[0] + 0.5


def test_the_verdict_tells_of_shrinkage_and_of_too_few_tilts():
    series, _, _ = shrunken("shells", -0.08, "dose-symmetric")
    result = recon.reconstruct(series, method="sirt", num_steps=10)
    finding = CHECKS["size of the specimen"].finding(Case(series, result))
    assert finding.cost >= 1
    assert finding.reason == "specimen"
    few = series.select(slice(None, None, 6))
    guard = recon.prepare(few).guard
    assert "shrinkage" not in guard.not_tested


@pytest.mark.slow
def test_refined_alignments_include_the_shrinkage():
    series, _, _ = shrunken("shells", -0.08, "dose-symmetric", noise=0.1)
    prepared = recon.prepare(series, refine_alignment=True)
    assert prepared.alignment.stretches is not None
    assert not estimate_shrinkage(prepared.tilt_series).found
