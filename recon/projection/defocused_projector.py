"""Blur of a convergent beam: by depth, exact layer by layer, or by the distance from the tilt axis."""

import math

import numpy as np
import torch
from torch import Tensor

from recon.projection.base import Projector
from recon.projection.projector import SliceProjector

_SUBPIXEL = 0.25
_MOST_LAYERS = 12
_REACH = 6  # truncation of kernels, standard deviations


KERNELS = ("depth", "image")
"""What the blur of a pixel depends on: the depth of each voxel, or the distance of the pixel from the tilt axis."""


def with_defocus(projector: SliceProjector, convergence: float, kernel: str = "depth") -> Projector:
    """The projector with blur if it is noticeable, otherwise the projector itself. Raises as `BlurredProjector`."""
    blurred = (ImageDefocusedProjector if kernel == "image" else DefocusedProjector)(projector, convergence)
    return blurred if len(blurred.blurs) > 1 else projector


class BlurredProjector(Projector):
    """Base class of line integrals of a convergent beam.

    Args:
        projector: the geometry, in focus.
        convergence: standard deviation of the beam's slopes, pixels of blur per voxel of distance; about half the convergence
            semi-angle in radians.

    Attributes:
        blurs: the standard deviations that occur, pixels; the first is zero.

    Raises:
        ValueError: `convergence` is negative or not finite.
    """

    blurs: list[float]

    def __init__(self, projector: SliceProjector, convergence: float) -> None:
        if not 0 <= convergence < math.inf:
            raise ValueError(f"convergence {convergence} must be zero or more, pixels of blur per voxel of distance")
        self.projector, self.convergence, self.tilt_angles = projector, convergence, projector.tilt_angles
        self.depth, self.width, self.detector_width = projector.depth, projector.width, projector.detector_width

    def __repr__(self) -> str:
        count = f"{len(self.blurs)} standard deviations"
        return f"{type(self).__name__}({self.projector!r}, convergence {self.convergence:g}, {count})"

    @property
    def device(self) -> torch.device:
        return self.projector.device

    @property
    def dtype(self) -> torch.dtype:
        return self.projector.dtype

    @property
    def reach(self) -> int:
        """Range of the blur, slices."""
        return _reach(max(self.blurs))

    @property
    def farthest(self) -> float:
        """Half the diagonal of a slice: no part of the specimen is farther from the focal plane, voxels."""
        return math.hypot(self.depth - 1, self.width - 1) / 2

    def images(self, rays: Tensor) -> Tensor:
        """Rays (tilts * detector_width, slices) as images (tilt, u, y), a view."""
        return rays.view(self.num_tilts, self.detector_width, -1)


class DefocusedProjector(BlurredProjector):
    """Line integrals of a convergent beam focused on the tilt axis; a replacement for `SliceProjector`.

    Voxels at a distance w from the focal plane, along the beam, are blurred by a Gaussian with standard deviation
    ``convergence``·\\|w\\| pixels along u and y. The volume is split into up to twelve layers of nearly equal blur. Each layer is
    projected by its part of the matrix and blurred by its own separable kernel. Blur below a quarter of a pixel is ignored; if
    that is the case everywhere, this equals the `SliceProjector`. Adjoint and gradients are exact. Arguments as for
    `BlurredProjector`.
    """

    def __init__(self, projector: SliceProjector, convergence: float) -> None:
        super().__init__(projector, convergence)
        farthest = convergence * self.farthest
        count = min(_MOST_LAYERS, math.ceil(max(0.0, farthest - _SUBPIXEL) / _SUBPIXEL))
        edges = np.linspace(_SUBPIXEL, max(farthest, _SUBPIXEL), count + 1)
        self.blurs, self._layers = [0.0, *((edges[1:] + edges[:-1]) / 2).tolist()], [projector]
        if count:
            self._layers = projector.layers(lambda distance: np.searchsorted(edges[:-1], convergence * abs(distance)))

    def project(self, columns: Tensor) -> Tensor:
        pairs, first = zip(self._layers[1:], self.blurs[1:], strict=False), self._layers[0].project(columns)
        return sum((self._blurred(layer.project(columns), blur) for layer, blur in pairs), first)

    def backproject(self, rays: Tensor) -> Tensor:
        pairs, first = zip(self._layers[1:], self.blurs[1:], strict=False), self._layers[0].backproject(rays)
        return sum((layer.backproject(self._blurred(rays, blur)) for layer, blur in pairs), first)

    def _blurred(self, rays: Tensor, blur: float) -> Tensor:
        return _blurred(self.images(rays), blur).reshape(rays.shape)


class ImageDefocusedProjector(BlurredProjector):
    """Line integrals blurred in the image, as Kniesel et al. (CVPR 2022, doi:10.1109/CVPR52688.2022.02018) do.

    The pixel at a distance d from the tilt axis is blurred by a Gaussian with standard deviation ``convergence``·tan(tilt)·d,
    along u and y. This equals the blur by depth for a specimen that is thin and lies in the focal plane at zero tilt. Widths are
    rounded to steps of a quarter of a pixel; below one step, blur is ignored. Adjoint and gradients are exact. Arguments as for
    `BlurredProjector`.
    """

    def __init__(self, projector: SliceProjector, convergence: float) -> None:
        super().__init__(projector, convergence)
        u = np.arange(self.detector_width) - (self.detector_width - 1) / 2 + projector.detector_offset[:, None]
        depth = np.minimum(np.abs(u * np.tan(np.deg2rad(self.tilt_angles))[:, None]), self.farthest)
        step = np.round(convergence * depth / _SUBPIXEL).astype(np.int64)
        steps = np.unique(np.append(step, 0))
        self.blurs = (steps * _SUBPIXEL).tolist()
        masks = (torch.from_numpy((step == each)[..., None]) for each in steps)
        self._shares = [mask.to(projector.device, projector.dtype) for mask in masks]

    def project(self, columns: Tensor) -> Tensor:
        rays = self.projector.project(columns)
        images = self.images(rays)
        parts = (share * _blurred(images, blur) for share, blur in zip(self._shares, self.blurs, strict=True))
        return sum(parts, torch.zeros_like(images)).reshape(rays.shape)

    def backproject(self, rays: Tensor) -> Tensor:
        images = self.images(rays)
        parts = (_blurred(share * images, blur) for share, blur in zip(self._shares, self.blurs, strict=True))
        return self.projector.backproject(sum(parts, torch.zeros_like(images)).reshape(rays.shape))


def _blurred(images: Tensor, blur: float) -> Tensor:
    """Images (tilt, u, y) blurred by a Gaussian of this standard deviation."""
    if not blur:
        return images
    along_u, along_y = (gaussian_matrix(size, blur, like=images) for size in images.shape[1:])
    return along_u @ images @ along_y


def _reach(deviation: float) -> int:
    return math.ceil(_REACH * deviation) + 1


def gaussian_matrix(size: int, deviation: float, *, like: Tensor) -> Tensor:
    """Symmetric (size, size) matrix of a sampled Gaussian with unit sum; values blurred across the edges are lost."""
    reach = torch.arange(-_reach(deviation), _reach(deviation) + 1, dtype=torch.float64)
    position = torch.arange(size, dtype=torch.float64)
    weights = torch.exp(-((position[:, None] - position) ** 2) / (2 * deviation**2))
    return (weights / torch.exp(-(reach**2) / (2 * deviation**2)).sum()).to(like)
