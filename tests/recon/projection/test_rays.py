"""The general ray marcher: agrees with the slice operator where that applies, and with exact line integrals elsewhere."""

import numpy as np
import pytest
import torch

from benchmarks.rays import march, view_matrices, view_rays
from recon.projection.projector import SliceProjector

ANGLES = [-63.0, -45.0, -10.5, 0.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0]


def random_volume(*shape, dtype=torch.float64):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize(("shape", "detector", "offset"), [((9, 4, 13), 13, 0.0), ((14, 3, 8), 17, 0.37)])
def test_marcher_agrees_with_the_slice_operator(shape, detector, offset, dtype, tolerance):
    volume = random_volume(*shape, dtype=dtype)
    options = {"depth": shape[0], "width": shape[2], "detector_width": detector, "detector_offset": offset}
    expected = SliceProjector(tilt_angles=ANGLES, dtype=dtype, **options)(volume)
    rays = view_rays(view_matrices(ANGLES), height=shape[1], width=detector, offset=offset)
    found = march(volume, *rays)
    assert found.dtype == dtype
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_gradient_of_the_marcher_is_the_adjoint_of_the_slice_operator():
    projector = SliceProjector(tilt_angles=ANGLES, depth=6, width=9, detector_width=11, dtype=torch.float64)
    images = random_volume(len(ANGLES), 3, 11)
    volume = random_volume(6, 3, 9).requires_grad_()
    rays = view_rays(view_matrices(ANGLES), height=3, width=11)
    (march(volume, *rays) * images).sum().backward()
    torch.testing.assert_close(volume.grad, projector.T(images), rtol=1e-10, atol=1e-10)


BLOB, WIDTH, SIZE = np.array([2.0, -3.0, 4.0]), 3.2, 40


def gaussian_volume():
    position = torch.arange(SIZE, dtype=torch.float64) - (SIZE - 1) / 2
    z, y, x = torch.meshgrid(position, position, position, indexing="ij")
    return torch.exp(-((z - BLOB[0]) ** 2 + (y - BLOB[1]) ** 2 + (x - BLOB[2]) ** 2) / (2 * WIDTH**2))


@pytest.mark.parametrize("geometry", [{}, {"x_tilt": 20.0}, {"in_plane": 90.0}, {"x_tilt": -15.0, "in_plane": 37.0}])
def test_blob_has_its_exact_shadow_in_every_geometry(geometry):
    """A Gaussian's shadow is the same Gaussian wherever it comes from; where it lands is worked out here by hand."""
    angles = np.array([-50.0, 0.0, 35.0, 70.0])
    images = march(gaussian_volume(), *view_rays(view_matrices(angles, **geometry), height=SIZE, width=SIZE))
    z, y, x = BLOB
    phi, chi = np.deg2rad(geometry.get("in_plane", 0.0)), np.deg2rad(geometry.get("x_tilt", 0.0))
    y, x = y * np.cos(phi) + x * np.sin(phi), x * np.cos(phi) - y * np.sin(phi)
    z, y = z * np.cos(chi) + y * np.sin(chi), y * np.cos(chi) - z * np.sin(chi)
    theta = np.deg2rad(angles)[:, None, None]
    u = x * np.cos(theta) + z * np.sin(theta)
    position = np.arange(SIZE) - (SIZE - 1) / 2
    squares = (position[:, None] - y) ** 2 + (position - u) ** 2
    expected = np.sqrt(2 * np.pi) * WIDTH * np.exp(-squares / (2 * WIDTH**2))
    assert np.abs(images.numpy() - expected).max() < 0.025 * expected.max()


def test_views_are_rotations():
    views = view_matrices(ANGLES, x_tilt=12.0, in_plane=-70.0)
    np.testing.assert_allclose(views @ views.transpose(0, 2, 1), np.broadcast_to(np.eye(3), views.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(views), 1)


def test_empty_and_missing_rays():
    volume = torch.ones(3, 4, 5)
    origins = torch.tensor([[0.0, 50.0, 0.0]])
    assert float(march(volume, origins, torch.tensor([[1.0, 0.0, 0.0]]))) == 0
    with pytest.raises(ValueError, match="zero length"):
        march(volume, origins, torch.zeros(1, 3))
    with pytest.raises(ValueError, match="volume"):
        march(volume[0], origins, origins)
