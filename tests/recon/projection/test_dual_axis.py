"""Two tilt axes: the stacked operator agrees with the general ray marcher, and is a linear operator with its adjoint."""

import numpy as np
import pytest
import torch

from benchmarks.rays import march, view_matrices, view_rays
from recon.projection.dual_axis import DualAxisProjector

ANGLES = np.array([-50.0, 40.0, 0.0, 30.0, -60.0])
SECOND = np.array([False, True, False, True, True])


def smooth(*shape):
    """Blobs near the middle; turned layers keep nothing beyond the grid."""
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in shape), indexing="ij")
    found = torch.zeros(shape, dtype=torch.float64)
    for place in ((1.0, -3.0, 4.0), (-2.0, 2.5, -3.0), (0.5, 5.0, 1.0)):
        found += torch.exp(-((z - place[0]) ** 2 + (y - place[1]) ** 2 + (x - place[2]) ** 2) / (2 * 2.5**2))
    return found


def marched(volume, axis, angles, second):
    """Each image by the ray marcher; about the second axis in its own frame, then turned as it is stored."""
    _, height, width = volume.shape
    found = torch.empty(len(angles), height, width, dtype=volume.dtype)
    first = view_rays(view_matrices(angles[~second]), height=height, width=width)
    found[~second] = march(volume, *first)
    views = view_matrices(angles[second], in_plane=-axis)
    own = march(volume, *view_rays(views, height=width, width=height))  # (tilt, along the axis, across it)
    found[second] = own.flip(1).transpose(1, 2)
    return found


@pytest.mark.parametrize(("axis", "tolerance"), [(90.0, 1e-10), (94.0, 0.01), (83.5, 0.01)])
def test_agrees_with_the_ray_marcher(axis, tolerance):
    volume = smooth(16, 28, 32)
    projector = DualAxisProjector(
        tilt_angles=ANGLES, axes=np.where(SECOND, axis, 0.0), depth=16, height=28, width=32, dtype=torch.float64
    )
    expected = marched(volume, axis, ANGLES, SECOND)
    assert (projector(volume) - expected).abs().max() < tolerance * expected.max()


@pytest.mark.parametrize("axis", [90.0, 86.0])
def test_backprojection_is_the_adjoint_and_the_gradient(axis):
    generator = torch.Generator().manual_seed(0)
    projector = DualAxisProjector(
        tilt_angles=ANGLES, axes=np.where(SECOND, axis, 0.0), depth=5, height=6, width=8, dtype=torch.float64
    )
    volume = torch.rand(5, 6, 8, dtype=torch.float64, generator=generator).requires_grad_()
    images = torch.rand(5, 6, 8, dtype=torch.float64, generator=generator)
    (projector(volume) * images).sum().backward()
    torch.testing.assert_close(volume.grad, projector.T(images), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    "axes", [np.zeros(5), np.full(5, 90.0), np.where(SECOND, 30.0, 0.0), np.array([0, 90, 0, 91, 90])]
)
def test_one_axis_and_close_axes_are_refused(axes):
    with pytest.raises(ValueError, match="axes"):
        DualAxisProjector(tilt_angles=ANGLES, axes=axes, depth=5, height=6, width=8)
