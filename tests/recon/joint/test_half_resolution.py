"""The first steps of a fit at half the resolution: the same scene, seen by fewer pixels."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from benchmarks.scenes import make_scene
from noiseflow import Gaussian
from recon.fields.fields import Field
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.fields.kinds.network import CoordinateNetwork
from recon.fields.occupancy import Occupancy
from recon.fields.regularisers import TotalVariation
from recon.joint.checkpoint import Journal
from recon.joint.joint import JointReconstructor
from recon.joint.signal_model import TomographySignal
from recon.joint.task import HalfResolution, Task
from recon.metrics.metrics import compare
from recon.projection.defocused_projector import with_defocus
from recon.projection.image_formation import Transmission
from recon.projection.projector import SliceProjector

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def _small_lattices_too(monkeypatch):
    monkeypatch.setattr(Field, "halved_from", (48, 1000))


_ANGLES = np.arange(-60, 61, 8.0)
_SHAPES = [(48, 40, 64), (50, 39, 63), (49, 42, 61)]  # (depth, height, width)


def smooth_model(shape, *, detector_width=None, occupancy=False, offset=0.0):
    """A soft ball well inside the lattice, which half the resolution holds nearly as well."""
    depth, _, width = shape
    projector = SliceProjector(
        tilt_angles=_ANGLES, depth=depth, width=width, detector_width=detector_width, detector_offset=offset
    )
    field = MultiresolutionField(shape, scale=0.05)
    places = [torch.linspace(-1, 1, 12) - shift for shift in (0.1, -0.2, 0.15)]
    distance = sum(place.view([-1 if axis == k else 1 for k in range(3)]) ** 2 for axis, place in enumerate(places))
    rough = functional.interpolate(torch.exp(-6 * distance)[None, None], size=field.grids[-2].shape, mode="trilinear")
    with torch.no_grad():
        for grid in field.grids:
            grid.zero_()
        field.grids[-2].copy_(7 * rough[0, 0] - 4)
    skip = Occupancy(torch.ones(1, 1, 1), shape) if occupancy else None
    return TomographySignal(field, projector, Transmission(1.0), weight=0.5, occupancy=skip)


def images_of(model):
    with torch.no_grad():
        return model.signal().view(len(_ANGLES), model.projector.detector_width, model.field.height)


@pytest.mark.parametrize("occupancy", [False, True])
@pytest.mark.parametrize("offset", [0.0, 1.3])
@pytest.mark.parametrize("shape", _SHAPES)
def test_half_the_resolution_sees_the_same(shape, offset, occupancy):
    model = smooth_model(shape, occupancy=occupancy, offset=offset, detector_width=shape[2] + 5)
    half = HalfResolution(model)
    seen, expected = images_of(half.signal_model), half.pixels(images_of(model))
    assert seen.shape == expected.shape
    assert 4 * seen.numel() <= 1.1 * model.num_pixels
    contrast, error = float(expected.max() - expected.min()), seen - expected
    assert contrast > 0.1
    assert float(error.square().mean().sqrt()) < 0.02 * contrast
    slopes = expected.diff(dim=1)[..., 1:], expected.diff(dim=2)[:, 1:]
    allowed = 0.3 if any(size % 2 for size in shape) else 0.05  # half of an odd number of voxels is a little too wide
    for slope in slopes:  # error along a slope is a shift, in pixels at half the resolution
        assert abs(float((error[:, 1:, 1:] * slope).sum() / slope.square().sum())) < allowed


def test_total_variation_weighs_as_much():
    model = smooth_model((64, 64, 64))
    model.regulariser = TotalVariation(smoothing=1e-3)
    half = HalfResolution(model).signal_model
    assert half.penalty().item() == pytest.approx(model.penalty().item(), rel=0.08)


def test_pixels_come_from_everywhere_and_are_as_they_were():
    half = HalfResolution(smooth_model(_SHAPES[0]))
    images = torch.arange(len(_ANGLES) * 64 * 40).view(len(_ANGLES), 64, 40)
    picked = half.pixels(images)
    columns, rows = picked // 40 % 64, picked % 40
    assert picked.shape == (len(_ANGLES), 32, 20)
    assert (columns.diff(dim=1) == 2).all()
    assert (rows.diff(dim=2) == 2).all()
    assert {(int(c), int(r)) for c, r in zip(columns[:, 0, 0], rows[:, 0, 0], strict=True)} == {
        (c, r) for c in (0, 1) for r in (0, 1)
    }


def test_what_is_learnt_is_learnt_for_both():
    model = smooth_model(_SHAPES[1])
    half = HalfResolution(model).signal_model
    before = model.volume()
    (half.signal().mean() + half.penalty()).backward()
    assert model.field.grids[-1].grad is None
    with torch.no_grad():
        for grid in model.field.grids[:-1]:
            grid -= 100 * grid.grad
    assert not torch.equal(model.volume(), before)
    assert model.image_formation is half.image_formation


def test_the_full_resolution_begins_around_what_was_found():
    model = smooth_model(_SHAPES[0], occupancy=True)
    HalfResolution(model).hand_over()
    something = (model.field.volume() > 0.3 * model.field.scale).transpose(1, 2)
    assert something.any()
    assert model.occupancy.mask[something].all()
    assert model.occupancy.share < 0.5


def test_voxels_small_lattices_and_defocus_stay_at_full_resolution():
    model = smooth_model(_SHAPES[0])
    assert HalfResolution.times(model) == 1
    small = smooth_model((24, 24, Field.halved_from[0] - 1))
    voxels = TomographySignal(VoxelField(_SHAPES[0]), model.projector, Transmission())
    blurred = TomographySignal(model.field, with_defocus(model.projector, 0.1), Transmission())
    for other in (small, voxels, blurred):
        assert HalfResolution.times(other) == 0


@pytest.mark.parametrize(("width", "times"), [(31, 0), (32, 1), (95, 1), (96, 2)])
def test_a_network_begins_at_a_lower_resolution_than_grids(width, times, monkeypatch):
    monkeypatch.undo()
    projector = SliceProjector(tilt_angles=[-30.0, 0.0, 30.0], depth=8, width=width)
    networks, grids = (
        TomographySignal(kind((8, 4, width)), projector, Transmission())
        for kind in (CoordinateNetwork, MultiresolutionField)
    )
    assert HalfResolution.times(networks) == times
    assert HalfResolution.times(grids) == 0


def test_a_wide_volume_begins_at_a_quarter_of_the_resolution(monkeypatch):
    shape = _SHAPES[0]
    model = smooth_model(shape)
    with torch.no_grad():
        *_, coarsest, coarse, _ = model.field.grids
        coarsest.copy_(functional.adaptive_avg_pool3d(coarse[None], coarsest.shape)[0])
        coarse.zero_()
    monkeypatch.setattr(Field, "halved_from", (shape[2], shape[2]))
    assert HalfResolution.times(model) == 2
    half = HalfResolution(model)
    quarter = HalfResolution(half.signal_model)
    seen = quarter.pixels(half.pixels(images_of(model)))
    found = images_of(quarter.signal_model)
    assert found.shape == seen.shape
    assert float((found - seen).abs().mean()) < 0.05 * float(seen.max() - seen.min())
    assert quarter.signal_model.field.grids[0] is model.field.grids[0], "what it learns, the whole has learnt"


def slices(phantom, seed=0):
    """Some slices: truth, noisy series and true noise."""
    whole, rows = make_scene(64, phantom=phantom, tilts="-60:60:4", seed=seed), slice(24, 40)
    return whole.truth[:, rows], replace(whole.noisy, images=whole.noisy.images[:, rows]), whole.noise_model


@pytest.mark.slow
def test_half_the_steps_at_half_the_resolution_lose_nothing():
    gains = []
    for phantom, seed in itertools.product(("shells", "virions"), range(4)):  # by chance, one alone may differ by 0.15
        truth, noisy, noise_model = slices(phantom, seed)
        fit = JointReconstructor(weight=0.4, noise_model=lambda noise_model=noise_model: noise_model)
        fits = [replace(fit, coarse_to_fine=wanted) for wanted in (True, False)]
        coarsely, finely = (compare(each(noisy).volume.attenuation, truth).psnr for each in fits)
        gains.append(coarsely - finely)
    assert np.mean(gains) > -0.05


def test_a_fit_stopped_at_half_the_resolution_goes_on(tmp_path):
    _, noisy, _ = slices("shells")
    fit = JointReconstructor(weight=0.4, noise_model=Gaussian, num_steps=16, slab=4)
    stopped = []

    def stop(task, done, total, note):
        if note.startswith("begin"):
            stopped.append(done)
            raise KeyboardInterrupt

    journal = Journal(tmp_path, {})
    with pytest.raises(KeyboardInterrupt):
        replace(fit, run_fit=journal.fit)(noisy, progress=stop)
    assert stopped
    resumed = replace(fit, run_fit=Journal(tmp_path, {}, resume=True).fit)(noisy).volume.attenuation
    np.testing.assert_allclose(resumed, fit(noisy).volume.attenuation, rtol=1e-5, atol=1e-5 * resumed.max())


def test_what_is_masked_at_full_resolution_is_masked_at_half():
    model = smooth_model(_SHAPES[0])
    images = images_of(model)
    use = torch.rand(images.shape, generator=torch.Generator().manual_seed(0)) < 0.7
    task = Task(model, torch.where(use, images, torch.nan), use, torch.zeros_like(use))
    with task.halved() as half:
        assert half.use is not None
        assert torch.equal(half.use, torch.isfinite(half.observation))
        assert 0 < int(half.use.sum()) < half.use.numel()


@pytest.mark.parametrize("through_rows", [False, True])
def test_what_counts_as_vacuum_is_the_same_at_both_resolutions_and_in_blocks(through_rows):
    shape = _SHAPES[0]
    shares = []
    for least in (0.2, 0.9):
        model = smooth_model(shape)
        model.occupancy = Occupancy(torch.ones(1, 1, 1), shape, least=least)
        if through_rows:
            model.occupancy = model.occupancy.rows(slice(0, shape[1]))
        HalfResolution(model).hand_over()
        shares.append(model.occupancy.share)
    assert 0 < shares[1] < 0.9 * shares[0]
