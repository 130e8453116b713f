"""The projector against a slow, obvious one, and its laws."""

import math

import numpy as np
import pytest
import torch

from recon.projection.projector import SliceProjector

ANGLES = [-63.0, -45.0, -10.5, 0.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0]


def slow_projection(volume, angles, detector_width, offset=0.0):
    """Joseph's sums, ray by ray and step by step, as in the paper of 1982."""
    depth, height, width = volume.shape
    images = np.zeros((len(angles), height, detector_width))
    for tilt, angle in enumerate(np.deg2rad(angles)):
        cosine, sine = math.cos(angle), math.sin(angle)
        for pixel in range(detector_width):
            u = pixel - (detector_width - 1) / 2 + offset
            along_z = abs(cosine) >= abs(sine)
            for step in range(depth if along_z else width):
                if along_z:
                    z = step - (depth - 1) / 2
                    position = (u - z * sine) / cosine + (width - 1) / 2
                else:
                    x = step - (width - 1) / 2
                    position = (u - x * cosine) / sine + (depth - 1) / 2
                low = math.floor(position)
                for index, share in ((low, 1 - (position - low)), (low + 1, position - low)):
                    if 0 <= index < (width if along_z else depth):
                        values = volume[step, :, index] if along_z else volume[index, :, step]
                        images[tilt, :, pixel] += values * share / max(abs(cosine), abs(sine))
    return images


@pytest.mark.parametrize(("shape", "detector_width", "offset"), [((9, 3, 13), 13, 0.0), ((14, 2, 8), 17, 0.37)])
def test_projection_equals_the_slow_one(shape, detector_width, offset):
    volume = np.random.default_rng(0).random(shape)
    projector = SliceProjector(
        tilt_angles=ANGLES,
        depth=shape[0],
        width=shape[2],
        detector_width=detector_width,
        detector_offset=offset,
        dtype=torch.float64,
    )
    expected = slow_projection(volume, ANGLES, detector_width, offset)
    np.testing.assert_allclose(projector(torch.from_numpy(volume)).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize("offset", [0.0, 0.37, "one per tilt"])
@pytest.mark.parametrize(("depth", "height", "width", "detector"), [(11, 5, 16, 19), (24, 3, 7, 12), (5, 40, 17, 17)])
def test_adjoint(depth, height, width, detector, offset, dtype, tolerance):
    generator = torch.Generator().manual_seed(0)
    offset = np.linspace(-1.5, 2, len(ANGLES)) if offset == "one per tilt" else offset
    options = {"depth": depth, "width": width, "detector_width": detector, "detector_offset": offset}
    projector = SliceProjector(tilt_angles=ANGLES, dtype=dtype, **options)
    x = torch.rand(depth, height, width, dtype=dtype, generator=generator)
    y = torch.rand(len(ANGLES), height, detector, dtype=dtype, generator=generator)
    forward, back = (projector(x) * y).sum(), (x * projector.T(y)).sum()
    assert abs(forward - back) < tolerance * abs(forward)


@pytest.mark.parametrize("num_tilts", [1, 31, 32, 33, 70])
def test_many_tilts_and_wide_slices_are_projected_as_one_by_one(num_tilts):
    """The matrices are built from 32 tilts at a time, in panels of 32 layers."""
    angles, offsets = np.linspace(-70, 65, num_tilts), np.linspace(-1, 2, num_tilts)
    volume = np.random.default_rng(0).random((35, 2, 3))
    whole = SliceProjector(
        tilt_angles=angles, depth=35, width=3, detector_width=4, detector_offset=offsets, dtype=torch.float64
    )
    expected = np.concatenate(
        [slow_projection(volume, [angle], 4, offset) for angle, offset in zip(angles, offsets, strict=True)]
    )
    np.testing.assert_allclose(whole(volume), expected, atol=1e-12)
    assert (whole.num_tilts, whole.detector_width, whole.dtype) == (num_tilts, 4, torch.float64)


@pytest.mark.parametrize("depth", [7, 12])
def test_a_layer_projects_what_lies_in_it(depth):
    width, detector = 10, 13
    whole = SliceProjector(tilt_angles=ANGLES, depth=depth, width=width, detector_width=detector, dtype=torch.float64)
    volume = np.random.default_rng(0).random((depth, 2, width))
    layer_of = lambda distance: np.digitize(distance, [-3.1, 0.2, 1.7])  # noqa: E731
    layers = whole.layers(layer_of)
    z, x = np.arange(depth) - (depth - 1) / 2, np.arange(width) - (width - 1) / 2
    for number, layer in enumerate(layers):
        for tilt, angle in enumerate(np.deg2rad(ANGLES)):
            inside = layer_of(z[:, None] * np.cos(angle) - x * np.sin(angle)) == number
            expected = slow_projection(volume * inside[:, None, :], ANGLES[tilt : tilt + 1], detector)
            np.testing.assert_allclose(layer(volume)[tilt], expected[0], atol=1e-12)
    assert len(layers) == 4
    assert len(whole.layers(lambda distance: np.zeros(distance.shape, int))) == 1


@pytest.mark.parametrize(("detector", "columns"), [(17, 8), (16, 8), (15, 7)])
def test_half_the_resolution_sees_every_second_pixel_at_half_the_scale(detector, columns):
    angles, offsets, first = [-40.0, 10.0, 70.0], np.array([0.0, 0.7, -1.3]), np.array([0, 1, 1])
    whole = SliceProjector(
        tilt_angles=angles, depth=9, width=14, detector_width=detector, detector_offset=offsets, dtype=torch.float64
    )
    half = whole.half(5, 7, columns, first)
    volume = np.random.default_rng(0).random((5, 2, 7))
    for tilt, angle in enumerate(angles):
        u = (first[tilt] + 2 * np.arange(columns) - (detector - 1) / 2 + offsets[tilt]) / 2  # in coarse voxels
        expected = slow_projection(volume, [angle], columns, u.mean())
        np.testing.assert_allclose(half(volume)[tilt], expected[0], atol=1e-12)
    assert whole.half(5, 7, columns, first) is half
    assert whole.half(5, 7, columns, 1 - first) is not half
    assert half.dtype == torch.float64


def test_a_part_is_the_matrix_of_some_columns():
    whole = SliceProjector(tilt_angles=[-50.0, 20.0], depth=40, width=5, dtype=torch.float64)
    identity = torch.eye(200, dtype=torch.float64)
    columns = torch.tensor([3, 77, 199])
    matrix, transposed = whole.part(columns)
    np.testing.assert_allclose(matrix.to_dense(), whole.project(identity)[:, columns], atol=1e-15)
    np.testing.assert_allclose(transposed.to_dense(), matrix.to_dense().T, atol=0)


def test_gradients_of_both_directions_to_second_order():
    projector = SliceProjector(tilt_angles=[-30.0, 20.0, 70.0], depth=4, width=5, dtype=torch.float64)
    x = torch.rand(20, 2, dtype=torch.float64, requires_grad=True)
    y = torch.rand(15, 2, dtype=torch.float64, requires_grad=True)
    for function, argument in ((projector.project, x), (projector.backproject, y)):
        assert torch.autograd.gradcheck(function, argument)
        assert torch.autograd.gradgradcheck(function, argument)


def test_sign_convention():
    volume = torch.zeros(21, 1, 21, dtype=torch.float64)
    volume[14, 0, 13] = 1  # z = 4, x = 3
    angle = 35.0
    projector = SliceProjector(tilt_angles=[angle], depth=21, width=21, dtype=torch.float64)
    image = projector(volume)[0, 0]
    u = torch.arange(21, dtype=torch.float64) - 10
    expected = 3 * math.cos(math.radians(angle)) + 4 * math.sin(math.radians(angle))
    assert float((image * u).sum() / image.sum()) == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turned_volume_equals_turned_geometry(turns):
    volume = torch.rand(12, 2, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    angles = np.array([-40.0, 5.0, 33.0])
    make = lambda a: SliceProjector(tilt_angles=a, depth=12, width=12, dtype=torch.float64)  # noqa: E731
    turned = torch.rot90(volume, turns, (0, 2))  # from z towards x, against the sense of the tilt
    np.testing.assert_allclose(make(angles - 90 * turns)(turned), make(angles)(volume), atol=1e-12)


def test_disc_gives_its_chord_lengths():
    size, radius = 128, 50.0
    position = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    fine = (torch.arange(8, dtype=torch.float64) - 3.5) / 8
    points = position[:, None] + fine
    inside = (points[:, None, :, None] ** 2 + points[None, :, None, :] ** 2 < radius**2).double().mean((2, 3))
    projector = SliceProjector(tilt_angles=[0.0, 17.0, 45.0, 71.0], depth=size, width=size, dtype=torch.float64)
    chords = 2 * torch.sqrt((radius**2 - position**2).clamp_min(0))
    inner = position.abs() < 0.95 * radius
    error = projector(inside[:, None])[:, 0] - chords
    assert error[:, inner].abs().max() < 0.02 * radius
    assert error.mean().abs() < 1e-3 * radius
    np.testing.assert_allclose(projector(inside[:, None]).sum((1, 2)), math.pi * radius**2, rtol=1e-3)


def test_native_layout_is_the_same_operator():
    projector = SliceProjector(tilt_angles=ANGLES, depth=7, width=9)
    volume = torch.rand(7, 4, 9)
    native = projector.project(volume.transpose(1, 2).reshape(63, 4)).view(len(ANGLES), 9, 4).transpose(1, 2)
    torch.testing.assert_close(native, projector(volume))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tilt_angles": []}, "tilt_angles"),
        ({"tilt_angles": [0.0, math.nan]}, "finite"),
        ({"tilt_angles": [0.0], "depth": 0}, "at least one"),
        ({"tilt_angles": [0.0], "width": 0, "detector_width": 3}, "at least one"),
        ({"tilt_angles": [0.0], "detector_width": 0}, "at least one"),
        ({"tilt_angles": [[0.0, 1.0], [2.0, 3.0]]}, "one per tilt"),
        ({"tilt_angles": [0.0, 1.0], "detector_offset": [1.0, 2.0, 3.0]}, "one per tilt"),
    ],
)
def test_wrong_geometry_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        SliceProjector(**({"depth": 4, "width": 4} | options))


def test_one_voxel_and_one_pixel_are_enough():
    one = SliceProjector(tilt_angles=0.0, depth=1, width=1, detector_width=1, dtype=torch.float64)
    assert float(one(torch.full((1, 1, 1), 3.0, dtype=torch.float64))) == pytest.approx(3.0)
    assert (one.device, one.dtype) == (torch.device("cpu"), torch.float64)


def test_wrong_shape_is_refused():
    projector = SliceProjector(tilt_angles=[0.0], depth=4, width=4)
    with pytest.raises(ValueError, match="attenuation"):
        projector(torch.zeros(5, 2, 4))
    with pytest.raises(ValueError, match="line_integrals"):
        projector.T(torch.zeros(1, 2, 5))
