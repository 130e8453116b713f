"""Registration finds known transforms, says how well, and never fails in silence."""

import numpy as np
import pytest
from scipy import ndimage

from calibration.exposures.frames import ExposurePair
from calibration.registration.align import Registration, register
from calibration.registration.aligned import align_pair

from ..conftest import expose, rigid, sparse_scene, textured_scene
from ..simulators import exposed, random_scene


def error_px(found: Registration, matrix, size: int) -> float:
    """Rms distance between two transforms over a frame."""
    y, x = np.mgrid[:size, :size]
    difference = (found.matrix - matrix) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    return float(np.sqrt((difference**2).sum(0).mean()))


def test_textured_pair_registers_to_a_twentieth_of_a_pixel(exposures):
    found = register(exposures.short, exposures.long)
    assert found.method == "sift"
    assert found.motion == "euclidean"
    assert found.inliers >= 20
    assert not found.inverted
    assert error_px(found, exposures.matrix, 192) < 0.05
    assert error_px(found, exposures.matrix, 192) < 4 * found.error_px
    assert found.rotation == pytest.approx(1.5, abs=0.05)
    assert found.shift((192, 192)) == pytest.approx((5.3, -3.6), abs=0.05)
    assert found.scale == pytest.approx(1, abs=1e-3)


def test_inverted_contrast_registers_as_well(exposures):
    found = register(exposures.short, 5000 - exposures.long)
    assert found.inverted
    assert error_px(found, exposures.matrix, 192) < 0.05


def test_motion_is_the_simplest_that_the_data_support():
    generator = np.random.default_rng(3)
    scene = textured_scene(generator, 160)
    shifted = expose(scene, rigid(0, (2.4, 1.2), 160), 160, generator)
    assert register(shifted.short, shifted.long).motion == "translation"
    stretched = np.array([[1.01, 0.004, -3.0], [-0.003, 0.985, 2.0]])
    sheared = expose(scene, stretched, 160, generator)
    found = register(sheared.short, sheared.long)
    assert found.motion == "affine"
    assert error_px(found, stretched, 160) < 0.06


def test_featureless_particles_fall_back_on_correlation():
    generator = np.random.default_rng(11)
    matrix = rigid(-2.2, (9.0, -6.0), 160)
    pair = expose(sparse_scene(generator, 160), matrix, 160, generator, electrons=8.0)
    blurred = ndimage.gaussian_filter(pair.long, 2.0)
    found = register(pair.short, blurred)
    assert error_px(found, matrix, 160) < 0.3


def test_method_says_when_correlation_was_used(monkeypatch, exposures):
    monkeypatch.setattr("calibration.registration.align.feature_guesses", lambda short, long: iter(()))
    found = register(exposures.short, exposures.long)
    assert found.method == "phase correlation"
    assert found.inliers == 0
    assert error_px(found, exposures.matrix, 192) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_unrelated_frames_are_refused(seed):
    generator = np.random.default_rng(seed)
    first, second = (
        expose(textured_scene(generator, 128), rigid(0, (0, 0), 128), 128, generator).short for _ in range(2)
    )
    with pytest.raises(ValueError, match="cannot be registered"):
        register(first, second)


def test_pure_noise_is_refused():
    first, second = np.random.default_rng(0).poisson(50, (2, 128, 128)).astype(float)
    with pytest.raises(ValueError, match="cannot be registered"):
        register(first, second)


def test_warp_brings_the_long_frame_onto_the_short(exposures):
    found = register(exposures.short, exposures.long)
    warped, mask = found.warp(exposures.long)
    expected = 100 + 16 * (exposures.signal - 100)
    noise = np.sqrt(2 * 16 * (exposures.signal - 100) + 4)
    assert np.std(((warped - expected) / noise)[mask]) < 1.1
    assert 0.8 < mask.mean() < 0.98


def test_a_transform_of_nothing_returns_the_frame_untouched(exposures):
    still = Registration(np.eye(2, 3), "translation", "sift", 9, 9, 0.1, 0.01, 50.0, False)
    warped, mask = still.warp(exposures.long)
    assert warped is exposures.long
    assert mask.all()


def test_a_small_rotation_is_not_lost_to_the_smoothing_of_a_half_pixel_shift():
    generator = np.random.default_rng(0)
    matrix, scene = rigid(0.4, (3.5, -2.5), 192), sparse_scene(generator, 192)
    y, x = np.mgrid[:192, :192].astype(float)
    moved = np.einsum("ij,jkl->ikl", matrix[:, :2], np.stack([x, y])) + matrix[:, 2][:, None, None]
    short = scene(*moved) + 0.5 * generator.standard_normal(x.shape)
    long = 16 * scene(x, y) + 4 * 0.5 * generator.standard_normal(x.shape)
    found = register(short, long)
    assert found.motion == "euclidean"
    assert error_px(found, matrix, 192) < 0.2


def test_a_few_matches_that_are_all_wrong_do_not_outweigh_the_correlation():
    generator = np.random.default_rng(
        20074
    )  # three particles of the one frame resemble three others, a quarter turn away
    scene, size = sparse_scene(generator, 256), 256
    snr, angle = generator.uniform(2, 5), generator.uniform(-3, 3)
    matrix = rigid(angle, tuple(generator.uniform(-0.1, 0.1, 2) * size), size)
    y, x = np.mgrid[:size, :size].astype(float)
    moved = np.einsum("ij,jkl->ikl", matrix[:, :2], np.stack([x, y])) + matrix[:, 2][:, None, None]
    short = scene(*moved) + generator.standard_normal(x.shape) / snr
    long = 16 * scene(x, y) + 4 * generator.standard_normal(x.shape) / snr
    assert error_px(register(short, long), matrix, size) < 0.3


def test_many_matches_that_agree_register_frames_of_little_overlap():
    generator = np.random.default_rng(0)
    scene = random_scene(generator, 512)
    short, long = (exposed(generator, times * scene[:256, x : x + 256]) for times, x in ((1, 0), (16, 154)))
    found = register(short, long)
    assert found.inliers > 100
    assert found.shift((256, 256)) == pytest.approx((-154, 0), abs=0.05)


def test_frames_of_a_smooth_gradient_are_compared_as_they_lie():
    generator, (y, x) = np.random.default_rng(0), np.mgrid[:256, :256] / 256
    electrons = 8 + 300 * (x * (0.5 + 0.5 * y) + 0.05 * np.sin(20 * y) * x)
    pair = ExposurePair(*(exposed(generator, times * electrons) for times in (1, 8)))
    with pytest.raises(ValueError, match="uniform light"):
        register(pair.short, pair.long)
    found = align_pair(pair).registration
    assert found.method == "unshifted"
    assert np.linalg.norm(found.shift(electrons.shape)) < 0.5
