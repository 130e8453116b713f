"""Matching of raw images with a coarse volume: the shift of every image, and the tilt axis."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from recon.projection.classical import sirt
from recon.projection.projector import SliceProjector
from recon.series.views import HARMLESS

ITERATIONS = 10
"""Iterations of SIRT between two steps of what else is fitted."""
ROUNDS = 5
"""Such steps, after which nothing near the solution moves by more than its error."""
FARTHEST = 3.0  # pixels per step, twice those of the edge by a turn: beyond, a blurred image is not linear in its shift


@dataclass(frozen=True)
class Match:
    """A tilt axis and shifts, with the volume reconstructed from the images aligned by them.

    Attributes:
        axis: radians from y towards −x.
        shifts: (tilt, (y, x)) shift of the aligned centre from the raw centre, raw pixels.
        volume: (z, y, x) at the size of the match.
    """

    axis: float
    shifts: Tensor
    volume: Tensor

    @property
    def degrees(self) -> float:
        """The axis in degrees."""
        return math.degrees(self.axis)

    @property
    def occupied(self) -> float:
        """Share of voxels that the volume fills: its squared sum over its sum of squares; small for compact volumes."""
        squares = self.volume.square().sum() * self.volume.numel()
        return float(self.volume.sum() ** 2 / squares) if squares > 0 else 1.0


class Matcher:
    """Binned images, and the projector of a cube of their width.

    Args:
        images: (tilt, y, x) line integrals.
        tilt_angles: (tilt,) degrees.
        binning: binning factor.
        used: (tilt, y, x) 1 for pixels to use, 0 for others; None for all.
        size: width of the cube, binned pixels; that of the images if None.
    """

    def __init__(
        self,
        images: Tensor,
        tilt_angles: NDArray[np.float64],
        binning: int,
        used: Tensor | None = None,
        *,
        size: int | None = None,
    ) -> None:
        self.images = _blurred(functional.avg_pool2d(images[:, None], binning))[:, 0]
        self.used = None if used is None else functional.avg_pool2d(used[:, None], binning)[:, 0]
        self.binning, self.size = binning, size or max(self.images.shape[1:])
        cut = torch.tensor([images.shape[1] % binning, images.shape[2] % binning], dtype=torch.float32)
        self._middle = (cut / 2).to(images.device)
        self.projector = SliceProjector(
            tilt_angles=tilt_angles, depth=self.size, width=self.size, device=str(images.device)
        )
        theta = np.deg2rad(tilt_angles)
        self._moves = torch.from_numpy(np.stack([np.sin(theta), np.cos(theta)], 1)).float().to(images.device)

    def match(self, axis: float, shifts: Tensor, *, rounds: int = 3 * ROUNDS, free_axis: bool = False) -> Match:
        """Alternate SIRT iterations with Gauss–Newton steps of all shifts, and of the axis, towards the projections."""
        shifts = self.in_own_pixels(shifts)
        volume = torch.zeros(self.size, self.size, self.size, device=self.images.device)
        for _ in range(rounds):
            images, seen = self.aligned(axis, shifts)
            volume = sirt(images, self.projector, num_iterations=ITERATIONS, start=volume, used=seen)
            move, turn = _gauss_newton(images, self.projector(volume), seen, free_axis=free_axis)
            shifts = shifts + move.clamp(-FARTHEST, FARTHEST) @ frame(axis, shifts)
            most = FARTHEST / self.size  # the edge moves by half as much
            axis += min(max(turn, -most), most)
        return Match(axis, shifts * self.binning - self._middle, volume)

    def in_own_pixels(self, shifts: Tensor) -> Tensor:
        """Convert shifts from raw pixels to binned pixels."""
        return (shifts + self._middle) / self.binning

    def aligned(self, axis: float, shifts: Tensor) -> tuple[Tensor, Tensor]:
        """Aligned images (tilt, y, u), and 1 where there is a used raw pixel; shifts in binned pixels."""
        raw = places(torch.Size([self.size, self.size]), shifts) @ frame(axis, shifts) + shifts[:, None, None, :]
        values, inside = sampled(self.images, raw)
        if self.used is not None:
            inside = inside * (sampled(self.used, raw)[0] > 1 - HARMLESS["masked part"])
        return values, inside

    def centred(self, found: Match) -> Match:
        """The match with the object centred in width and depth of the volume.

        Shifts determine an object except for its position. If it is centred, it fits into a thin volume, and its shifts do not
        depend on the scale of the tilt angles, unlike those of an object far from the axis. Voxels are weighted by their squares,
        because SIRT with non-negativity turns noise into mass everywhere.
        """
        place = torch.tensor([_middle(found.volume.square().sum(other)) for other in ((1, 2), (0, 1))]) * self.binning
        across = self._moves @ place.to(self._moves)
        moves = torch.stack([torch.zeros_like(across), across], -1)
        return replace(found, shifts=found.shifts + moves @ frame(found.axis, moves))

    def about_mass(self, found: Match, turn: float) -> tuple[float, Tensor]:
        """Axis and shifts after a rotation about the centre of mass along the axis, which changes the images least."""
        mass = found.volume.sum((0, 2))  # may be at a coarser size
        place = torch.tensor([_middle(mass) * self.size * self.binning / len(mass), 0.0], device=mass.device)
        moved = place @ (frame(found.axis, place) - frame(found.axis + turn, place))
        return found.axis + turn, found.shifts + moved

    def neighbours_correlated(self, order: list[int]) -> Tensor:
        """Shifts, raw pixels, by cross-correlation of every image with its neighbour, outwards from the first of `order`."""
        window = torch.outer(*(torch.hann_window(size, periodic=False) for size in self.images.shape[1:]))
        flat = (self.images - self.images.mean((1, 2), keepdim=True)) * window.to(self.images.device)
        spectra = torch.fft.fft2(flat)
        shifts = torch.zeros(len(flat), 2, device=flat.device)
        extent = torch.tensor(flat.shape[1:], device=flat.device)
        for before, after in pairwise(order):
            peak = int(torch.fft.ifft2(spectra[after] * spectra[before].conj()).real.argmax())
            place = torch.tensor([peak // flat.shape[2], peak % flat.shape[2]], device=flat.device)
            shifts[after] = shifts[before] + torch.where(place > extent // 2, place - extent, place)
        return shifts * self.binning


def frame(axis: float, like: Tensor) -> Tensor:
    """Matrix whose rows are the y and u directions of the aligned frame in raw (y, x)."""
    cosine, sine = math.cos(axis), math.sin(axis)
    return torch.tensor([[cosine, -sine], [sine, cosine]], dtype=like.dtype, device=like.device)


def places(shape: torch.Size, like: Tensor) -> Tensor:
    """Positions (y, x) of all pixels relative to the centre, (height, width, 2)."""
    sides = (torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2 for size in shape)
    return torch.stack(torch.meshgrid(*sides, indexing="ij"), -1)


def sampled(images: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
    """Images (tilt, y, x) at positions (tilt, ..., 2) relative to their centre, and 1 where these are inside."""
    extent = torch.tensor(images.shape[1:], device=images.device)
    grid = (2 * where / extent).flip(-1)
    values = functional.grid_sample(images[:, None], grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values[:, 0], (where.abs() <= (extent - 1) / 2).all(-1).float()


def _gauss_newton(images: Tensor, predicted: Tensor, seen: Tensor, *, free_axis: bool) -> tuple[Tensor, float]:
    """Shifts (tilt, (y, u)) and rotation (radians) of the sampling points that best match images and predictions."""
    down, across = torch.zeros_like(predicted), torch.zeros_like(predicted)
    down[:, 1:-1] = (predicted[:, 2:] - predicted[:, :-2]) / 2
    across[:, :, 1:-1] = (predicted[:, :, 2:] - predicted[:, :, :-2]) / 2
    position = torch.arange(predicted.shape[1], device=predicted.device) - (predicted.shape[1] - 1) / 2
    slopes = torch.stack([down, across, down * position - across * position[:, None]], 1)
    weighted = (slopes * seen[:, None]).flatten(2).double()
    normal = weighted @ slopes.flatten(2).double().mT
    right = (weighted @ (predicted - images).flatten(1).double()[:, :, None])[..., 0]
    ridge = 1e-6 * normal[:, :2, :2].diagonal(dim1=1, dim2=2).mean() + 1e-30
    own, both = normal[:, :2, :2] + ridge * torch.eye(2, device=normal.device), normal[:, :2, 2]
    moves = torch.linalg.solve(own, right[:, :2])
    if not free_axis:
        return moves.float(), 0.0
    coupled = torch.linalg.solve(own, both)
    free = normal[:, 2, 2].sum() - (both * coupled).sum()
    turn = float((right[:, 2].sum() - (both * moves).sum()) / free.clamp_min(1e-30))
    return (moves - turn * coupled).float(), turn


def _middle(mass: Tensor) -> float:
    """Centre of mass relative to the centre of the array, in its pixels."""
    position = torch.arange(len(mass), device=mass.device) - (len(mass) - 1) / 2
    return float((mass * position).sum() / mass.sum().clamp_min(1e-30))


def _blurred(images: Tensor) -> Tensor:
    """Blur images slightly, so that interpolation hardly changes their noise."""
    kernel = torch.tensor([0.25, 0.5, 0.25], device=images.device)
    padded = functional.pad(images, (1, 1, 1, 1), mode="replicate")
    return functional.conv2d(padded, torch.outer(kernel, kernel)[None, None])
