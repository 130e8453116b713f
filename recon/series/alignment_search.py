"""The alignment of a raw tilt series, found together with a coarse volume of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from recon.projection.projector import SliceProjector
from recon.series.alignment import Alignment
from recon.series.first_guess import estimate_response
from recon.series.tilt_series import TiltSeries

Progress = Callable[[str, int, int, str], None]
_COARSEST, _SEARCHED, _FINEST = 16, 64, 160
_SPACING, _STEPS = 15.0, (5.0, 2.5)
_ROUNDS, _FEWER_ROUNDS, _ITERATIONS = 15, 5, 10
_MOST_TURN = math.radians(3)


def find_alignment(
    tilt_series: TiltSeries,
    *,
    tilt_axis: float | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Alignment:
    """Find the tilt axis and every image's shift together with a volume, from 16 pixels wide up to full size or 160.

    At each size, iterations of SIRT on the images as they are aligned so far take turns with a Gauss-Newton step of all shifts,
    and of the axis, towards the volume's projections. At the smallest size this is tried for directions all around, from no
    shifts and from those that cross-correlation of neighbours finds; the one that explains the images best is taken on.

    Args:
        tilt_series: raw images, in any orientation.
        tilt_axis: degrees from y towards −x, where it is known to some degrees; searched if None.
        device: where to compute.
        progress: told of every size.

    Raises:
        ValueError: fewer than five tilts.
    """
    if tilt_series.num_tilts < 5:
        raise ValueError(f"{tilt_series.num_tilts} tilts are too few to align; leave out --refine-alignment")
    images = _line_integrals(tilt_series).to(device)
    binnings = _binnings(max(images.shape[1:]))
    with torch.no_grad():
        found = _first(_Matcher(images, tilt_series.tilt_angles, binnings[0]), tilt_axis)
        for done, binning in enumerate(binnings, 1):
            matcher = _Matcher(images, tilt_series.tilt_angles, binning)
            searched = matcher.size <= _SEARCHED
            for step in _STEPS if searched else ():
                found = _turned(matcher, found, math.radians(step))
            found = matcher.centred(matcher.match(found.axis, found.shifts, free_axis=not searched))
            if progress is not None:
                progress("aligning", done, len(binnings), f"axis {math.degrees(found.axis):.2f}°")
    shifts = found.shifts.double().cpu().numpy()
    return Alignment(math.degrees(found.axis), shifts, tilt_series.tilt_angles, found.residual)


@dataclass(frozen=True)
class _Found:
    """Axis (radians), shifts (tilt, (y, x)) in raw pixels, the share of variance left, and the volume."""

    axis: float
    shifts: Tensor
    residual: float
    volume: Tensor


class _Matcher:
    """Images averaged over squares of pixels, and the projector of a cube as wide as they are."""

    def __init__(self, images: Tensor, tilt_angles: np.ndarray[tuple[int], np.dtype[np.float64]], binning: int) -> None:
        self.images = _blurred(functional.avg_pool2d(images[:, None], binning))[:, 0]
        self.binning, self.size = binning, max(self.images.shape[1:])
        cut = torch.tensor([images.shape[1] % binning, images.shape[2] % binning], dtype=torch.float32)
        self.middle = (cut / 2).to(images.device)
        self.projector = SliceProjector(
            tilt_angles=tilt_angles, depth=self.size, width=self.size, device=str(images.device)
        )
        self.sine = torch.from_numpy(np.sin(np.deg2rad(tilt_angles))).float().to(images.device)

    def match(self, axis: float, shifts: Tensor, *, rounds: int = _ROUNDS, free_axis: bool = False) -> _Found:
        """Volume and alignment in turns, from where they are given."""
        shifts, volume = (shifts + self.middle) / self.binning, torch.zeros(0)
        for _ in range(rounds):
            images, seen = self.aligned(axis, shifts)
            volume = self._sirt(images, seen, volume if volume.numel() else None, _ITERATIONS)
            predicted = self.projector(volume)
            move, turn = _gauss_newton(images, predicted, seen, free_axis=free_axis)
            move, turn = move.clamp(-3, 3), min(max(turn, -_MOST_TURN), _MOST_TURN)
            shifts = shifts + move @ _frame(axis, shifts)
            axis += turn
        residual = self._judge(axis, shifts)
        return _Found(axis, shifts * self.binning - self.middle, residual, volume)

    def _judge(self, axis: float, shifts: Tensor) -> float:
        """Share of the raw images' variance that volumes of the even tilts leave in the odd ones, and the other way round.

        Raw pixels are compared, which nothing has smoothed, with tilts that the volume has not seen: otherwise a direction
        along the rows, which smooths noise least and fits it best, would win too often.
        """
        images, seen = self.aligned(axis, shifts)
        every = torch.arange(len(images), device=images.device) % 2
        frame = _frame(axis, shifts)
        left = whole = 0.0
        for half in (0, 1):
            volume = self._sirt(images, seen * (every == half)[:, None, None], None, 3 * _ITERATIONS)
            unseen = every != half
            predicted = self.projector(volume)[unseen]
            there = (_pixels(self.images.shape[1:], shifts) - shifts[unseen][:, None, None, :]) @ frame.T
            clean, inside = _sampled(predicted, there)
            measured = self.images[unseen]
            left += float(((clean - measured).square() * inside).sum())
            whole += float(((measured - measured.mean()).square() * inside).sum())
        return left / whole

    def aligned(self, axis: float, shifts: Tensor) -> tuple[Tensor, Tensor]:
        """Images (tilt, y, u) of the aligned frame, and where they are inside the raw ones."""
        square = torch.Size([self.size, self.size])
        raw = _pixels(square, shifts) @ _frame(axis, shifts) + shifts[:, None, None, :]
        return _sampled(self.images, raw)

    def centred(self, found: _Found) -> _Found:
        """The same with the volume's mass in the middle of its depth, for the whole object shall fit a slab."""
        height = _middle(found.volume.sum((1, 2))) * self.binning
        across = torch.stack([torch.zeros_like(self.sine), height * self.sine], -1)
        return _Found(found.axis, found.shifts + across @ _frame(found.axis, across), found.residual, found.volume)

    def about_mass(self, found: _Found, turn: float) -> tuple[float, Tensor]:
        """Axis and shifts after a turn about the place on the axis where most of the mass is: the least disturbance."""
        mass = found.volume.sum((0, 2))  # perhaps of a coarser size
        height = _middle(mass) * self.size * self.binning / len(mass)
        place = torch.tensor([height, 0.0], device=mass.device)
        moved = place @ (_frame(found.axis, place) - _frame(found.axis + turn, place))
        return found.axis + turn, found.shifts + moved

    def neighbours_correlated(self, order: list[int]) -> Tensor:
        """Shifts, in raw pixels, that fit every image to its neighbour in angle, from the first of `order` outwards."""
        window = torch.outer(*(torch.hann_window(size, periodic=False) for size in self.images.shape[1:]))
        flat = (self.images - self.images.mean((1, 2), keepdim=True)) * window.to(self.images.device)
        spectra = torch.fft.fft2(flat)
        shifts = torch.zeros(len(flat), 2, device=flat.device)
        for before, after in pairwise(order):
            product = torch.fft.ifft2(spectra[after] * spectra[before].conj()).real
            peak = int(product.argmax())
            place = torch.tensor([peak // flat.shape[2], peak % flat.shape[2]], device=flat.device)
            extent = torch.tensor(flat.shape[1:], device=flat.device)
            shifts[after] = shifts[before] + torch.where(place > extent // 2, place - extent, place)
        return shifts * self.binning

    def _sirt(self, images: Tensor, seen: Tensor, volume: Tensor | None, num_iterations: int) -> Tensor:
        """Iterations of SIRT in which pixels outside the raw images do not count."""
        A = self.projector
        if volume is None:
            volume = torch.zeros(A.depth, images.shape[1], A.width, device=images.device)
        lengths, weights = A(torch.ones_like(volume[:, :1])), A.T(seen)
        inverse = torch.where(weights > 1e-3, 1 / weights, 0.0)
        rows = torch.where(lengths > 0, 1 / lengths, 0.0) * seen
        for _ in range(num_iterations):
            volume = (volume + inverse * A.T(rows * (images - A(volume)))).clamp_min(0)
        return volume


def _first(matcher: _Matcher, tilt_axis: float | None) -> _Found:
    """The best of many directions and two starts, at the smallest size."""
    degrees = np.arange(-90, 90, _SPACING) if tilt_axis is None else np.array([tilt_axis])
    ranked = np.argsort(matcher.projector.tilt_angles).tolist()
    upright = int(np.argmin(np.abs(matcher.projector.tilt_angles[ranked])))
    up, down = (matcher.neighbours_correlated(half) for half in (ranked[upright:], ranked[upright::-1]))
    starts = torch.zeros_like(up), up + down
    tried = [matcher.match(math.radians(angle), start) for angle in degrees for start in starts]
    return min(tried, key=lambda found: found.residual)


def _turned(matcher: _Matcher, found: _Found, step: float) -> _Found:
    """The axis where the parabola through three directions has its least residual."""
    sides = (-1.0, 0.0, 1.0)
    tried = [matcher.match(*matcher.about_mass(found, side * step), rounds=_FEWER_ROUNDS) for side in sides]
    left, middle, right = (each.residual for each in tried)
    curvature = left - 2 * middle + right
    place = 0.5 * (left - right) / curvature if curvature > 0 else math.copysign(1.5, left - right)
    nearest = tried[int(np.argmin([left, middle, right]))]
    turn = found.axis + step * min(max(place, -1.5), 1.5) - nearest.axis
    last = matcher.match(*matcher.about_mass(nearest, turn), rounds=_FEWER_ROUNDS)
    return min(nearest, last, key=lambda each: each.residual)


def _gauss_newton(images: Tensor, predicted: Tensor, seen: Tensor, *, free_axis: bool) -> tuple[Tensor, float]:
    """Moves (tilt, (y, u)) and turn (radians) of the sampling points that bring the images nearest to the predicted ones."""
    down, across = torch.zeros_like(predicted), torch.zeros_like(predicted)
    down[:, 1:-1] = (predicted[:, 2:] - predicted[:, :-2]) / 2
    across[:, :, 1:-1] = (predicted[:, :, 2:] - predicted[:, :, :-2]) / 2
    position = torch.arange(predicted.shape[1], device=predicted.device) - (predicted.shape[1] - 1) / 2
    slopes = torch.stack([down, across, down * position - across * position[:, None]], 1)
    weighted = (slopes * seen[:, None]).flatten(2).double()
    normal = weighted @ slopes.flatten(2).double().mT
    right = (weighted @ (predicted - images).flatten(1).double()[:, :, None])[..., 0]
    ridge = 1e-6 * normal[:, :2, :2].diagonal(dim1=1, dim2=2).mean() * torch.eye(2, device=normal.device) + 1e-30
    own, both = normal[:, :2, :2] + ridge, normal[:, :2, 2]
    moves = torch.linalg.solve(own, right[:, :2])
    if not free_axis:
        return moves.float(), 0.0
    coupled = torch.linalg.solve(own, both)
    free = normal[:, 2, 2].sum() - (both * coupled).sum()
    turn = float((right[:, 2].sum() - (both * moves).sum()) / free.clamp_min(1e-30))
    return (moves - turn * coupled).float(), turn


def _middle(mass: Tensor) -> float:
    """Where the middle of a mass is from the middle of its extent, in its own pixels."""
    position = torch.arange(len(mass), device=mass.device) - (len(mass) - 1) / 2
    return float((mass * position).sum() / mass.sum().clamp_min(1e-30))


def _pixels(shape: torch.Size, like: Tensor) -> Tensor:
    """Places (y, x) of all pixels, from the middle, (height, width, 2)."""
    sides = (torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2 for size in shape)
    return torch.stack(torch.meshgrid(*sides, indexing="ij"), -1)


def _sampled(images: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Images (tilt, y, x) at places (tilt, ..., 2) from their middle, and 1 where these are inside."""
    extent = torch.tensor(images.shape[1:], device=images.device)
    grid = (2 * places / extent).flip(-1)
    values = functional.grid_sample(images[:, None], grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values[:, 0], (places.abs() <= (extent - 1) / 2).all(-1).float()


def _frame(axis: float, like: Tensor) -> Tensor:
    """Rows: the aligned frame's y and u directions in raw (y, x)."""
    cosine, sine = math.cos(axis), math.sin(axis)
    return torch.tensor([[cosine, -sine], [sine, cosine]], dtype=like.dtype, device=like.device)


def _line_integrals(tilt_series: TiltSeries) -> Tensor:
    """Images as line integrals, of order one."""
    images = torch.from_numpy(tilt_series.images.astype(np.float32))
    integrals = estimate_response(tilt_series).invert(images).detach()
    return integrals / integrals.std().clamp_min(1e-30)


def _binnings(size: int) -> list[int]:
    """From about 16 pixels wide, finer by two each, to full size or to what is at most 160 wide."""
    binnings = [max(1, round(size / _COARSEST))]
    while binnings[-1] > max(1, math.ceil(size / _FINEST)):
        binnings.append(max(binnings[-1] // 2, math.ceil(size / _FINEST)))
    return binnings


def _blurred(images: Tensor) -> Tensor:
    """A little, so that interpolation changes the noise hardly any more."""
    kernel = torch.tensor([0.25, 0.5, 0.25], device=images.device)
    padded = functional.pad(images, (1, 1, 1, 1), mode="replicate")
    return functional.conv2d(padded, torch.outer(kernel, kernel)[None, None])
