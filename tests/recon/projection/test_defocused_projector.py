"""Blur by depth: the exact layers against jittered rays and against a slow sum, and the laws of the operator."""

import math

import numpy as np
import pytest
import torch

from benchmarks.defocus import defocused_scene
from benchmarks.rays import march, view_matrices, view_rays
from benchmarks.scenes import make_scene
from recon.joint.joint import JointReconstructor
from recon.methods import _registry as methods
from recon.metrics.metrics import compare
from recon.projection.classical import sirt
from recon.projection.defocused_projector import (
    KERNELS,
    DefocusedProjector,
    ImageDefocusedProjector,
    with_defocus,
)
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import VolumeGrid

ANGLES = [-60.0, -20.0, 0.0, 35.0, 70.0]


def projector(depth=20, width=24, **options):
    return SliceProjector(tilt_angles=ANGLES, depth=depth, width=width, dtype=torch.float64, **options)


def random_volume(*shape):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_layers_add_up_to_the_whole():
    whole, volume = projector(), random_volume(20, 3, 24)
    layers = whole.layers(lambda distance: np.digitize(distance, [-5.0, 0.0, 4.0]))
    assert len(layers) == 4
    torch.testing.assert_close(sum(layer(volume) for layer in layers), whole(volume))
    torch.testing.assert_close(sum(layer.T(whole(volume)) for layer in layers), whole.T(whole(volume)))


def test_point_is_blurred_by_its_distance_from_the_focal_plane(monkeypatch):
    monkeypatch.setattr("recon.projection.defocused_projector._MOST_LAYERS", 40)
    volume = torch.zeros(41, 41, 41, dtype=torch.float64)
    volume[34, 20, 26] = 1  # z = 14, x = 6
    operator = DefocusedProjector(projector(41, 41), 0.15)
    position = torch.arange(41, dtype=torch.float64) - 20
    for angle, image in zip(np.deg2rad(ANGLES), operator(volume), strict=True):
        distance = 14 * math.cos(angle) - 6 * math.sin(angle)
        along_y = image.sum(1) / image.sum()
        spread = math.sqrt(float((along_y * position**2).sum()))
        assert spread == pytest.approx(0.15 * abs(distance), abs=0.13)  # half a layer


def test_blur_in_the_image_is_that_of_the_paper():
    """A pixel at distance d from the axis has a Gaussian of tan(tilt)·d, whatever the depth of what it shows."""
    operator = ImageDefocusedProjector(projector(41, 61), 0.15)
    position = torch.arange(61, dtype=torch.float64) - 30
    columns = torch.zeros(41 * 61, 61, dtype=torch.float64)
    columns[:, 30] = 1.0  # one slice of constant attenuation: along y, the image of each pixel is its kernel
    images = operator.project(columns).view(len(ANGLES), 61, 61)
    sharp = projector(41, 61).project(columns).view(len(ANGLES), 61, 61).sum(2)
    for angle, image, line in zip(np.deg2rad(ANGLES), images, sharp, strict=True):
        for u in (2, 10, 25, 40, 58):
            if line[u] > 0:
                share = image[u] / image[u].sum()
                deviation = math.sqrt(float((share * position**2).sum()))
                expected = 0.15 * min(abs(math.tan(angle) * (u - 30)), math.hypot(40, 60) / 2)
                # half a step; a sampled Gaussian of a quarter of a pixel is a single pixel
                assert deviation == pytest.approx(expected, abs=0.13 if expected > 0.4 else 0.4)


def test_both_kernels_agree_on_a_thin_specimen():
    volume = torch.zeros(1, 31, 31, dtype=torch.float64)
    volume[0, 15, 4:28:6] = 1.0
    sharp = SliceProjector(tilt_angles=[-30.0, 45.0], depth=1, width=31, dtype=torch.float64)
    depth, image = (with_defocus(sharp, 0.2, kernel)(volume) for kernel in KERNELS)
    # both round widths, to the quarter of a pixel or its middle: 0.125 of 1 to 2 pixels
    assert float((depth - image).square().mean()) < 0.05 * float(depth.square().mean())
    assert float((sharp(volume) - image).square().mean()) > 0.2 * float(depth.square().mean())


def jittered_projection(volume, tilt_angles, convergence, *, num_rays, generator):
    """The same images by Monte Carlo: the mean over rays with random slopes through each pixel's place in the focal plane."""
    views = view_matrices(tilt_angles)
    _, height, width = volume.shape
    total = volume.new_zeros(len(views), height, width)
    for _ in range(num_rays):
        slopes = convergence * torch.randn(*total.shape, 2, generator=generator, dtype=torch.float64)
        origins, directions = view_rays(views, height=height, width=width)
        beside = torch.cat([torch.zeros_like(slopes[..., :1]), slopes], -1) @ torch.from_numpy(views)[:, None]
        total = total + march(volume, origins, directions + beside)
    return total / num_rays


def test_exact_and_jittered_blur_agree():
    position = torch.arange(20, dtype=torch.float64) - 9.5
    z, y, x = torch.meshgrid(position[2:-2], position, position, indexing="ij")
    volume = torch.exp(-((z - 5) ** 2 + y**2 + x**2) / 6) + torch.exp(-((z + 4) ** 2 + (y - 1) ** 2 + (x - 3) ** 2) / 6)
    sharp = SliceProjector(tilt_angles=[-60.0, 35.0], depth=16, width=20, dtype=torch.float64)
    exact = DefocusedProjector(sharp, 0.3)(volume)
    generator = torch.Generator().manual_seed(0)
    random = jittered_projection(volume, [-60.0, 35.0], 0.3, num_rays=400, generator=generator)
    inner = (slice(None), slice(2, -2), slice(2, -2))  # blur ends at the detector's edges, rays do not
    error = (exact - random)[inner].square().mean().sqrt()
    change = (sharp(volume) - random)[inner].square().mean().sqrt()
    assert error < 0.01 * random.max()
    assert error < 0.15 * change


def test_adjoint_and_gradient():
    operator = DefocusedProjector(projector(7, 11, detector_width=13), 0.3)
    assert len(operator.blurs) > 3
    x, y = random_volume(7, 5, 11).requires_grad_(), random_volume(5, 5, 13)
    forward, back = (operator(x) * y).sum(), (x * operator.T(y)).sum()
    assert abs(forward - back) < 1e-10 * abs(forward)
    forward.backward()
    torch.testing.assert_close(x.grad, operator.T(y))


def test_blur_below_a_quarter_of_a_pixel_is_skipped():
    sharp, volume = projector(), random_volume(20, 3, 24)
    operator = DefocusedProjector(sharp, 0.01)
    assert operator.blurs == [0.0]
    torch.testing.assert_close(operator(volume), sharp(volume), rtol=0, atol=0)


def test_knowing_the_blur_sharpens_the_reconstruction():
    truth = torch.zeros(20, 12, 24, dtype=torch.float64)
    truth[2:5, 4:8, 10:13] = truth[15:18, 4:8, 6:9] = 1
    blurred = DefocusedProjector(projector(), 0.15)
    images = blurred(truth)
    error = {
        name: float((sirt(images, operator, num_iterations=100) - truth).square().mean())
        for name, operator in {"known": blurred, "ignored": projector()}.items()
    }
    assert error["known"] < 0.8 * error["ignored"]


def test_impossible_convergence_is_refused():
    with pytest.raises(ValueError, match="convergence"):
        DefocusedProjector(projector(), -0.1)


def test_blur_below_a_quarter_of_a_pixel_leaves_the_projector_as_it_is():
    sharp = projector()
    assert with_defocus(sharp, 0.01) is sharp
    assert isinstance(with_defocus(sharp, 0.1), DefocusedProjector)


@pytest.fixture(scope="module")
def defocused():
    return defocused_scene(make_scene(32, phantom="shells", noise="skewed", tilts="-60:60:5"), 0.15)


def test_joint_fit_that_knows_the_defocus_finds_the_better_volume(defocused):
    psnr = {}
    for defocus in (0.0, 0.15):
        fit = JointReconstructor(weight=0.3, noise_model=lambda: defocused.noise_model, defocus=defocus)
        psnr[defocus] = compare(fit(defocused.noisy).volume.attenuation, defocused.truth).psnr
    assert psnr[0.15] > psnr[0.0] + 0.4


def test_methods_model_it_or_refuse_and_say_what_they_did(tmp_path):
    defocused = defocused_scene(make_scene(12, phantom="shells", noise="skewed", tilts="-60:60:20"), 0.3)
    grid, options = VolumeGrid.of(defocused.noisy), {"weight": 0.3, "num_steps": 4}
    outcome = methods.reconstruct(defocused.noisy, grid, method="l2", defocus=0.3, **options)
    assert outcome.choices["defocus"].startswith("0.3, blurs up to 2.")
    left_out = methods.reconstruct(defocused.noisy, grid, method="l2", defocus=0.001, **options)
    assert "ignored" in left_out.choices["defocus"]
    blocks = methods.reconstruct(
        defocused.noisy, grid, scratch=tmp_path / "v.npy", method="l2", slices_at_once=8, defocus=0.3, **options
    )
    assert blocks.choices["defocus"] == outcome.choices["defocus"]
    with pytest.raises(ValueError, match="--defocus"):
        methods.reconstruct(defocused.noisy, grid, method="sirt", defocus=0.3)
    with pytest.raises(ValueError, match="--defocus"):
        methods.reconstruct(
            defocused.noisy, grid, scratch=tmp_path / "w.npy", method="wbp", slices_at_once=9, defocus=0.3
        )
    with pytest.raises(ValueError, match="0 to 1"):
        methods.reconstruct(defocused.noisy, grid, method="l2", defocus=-0.1)
