"""Registration of two tilt series of one specimen, about two axes: rotation and shift in three dimensions."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from noiseflow.described import described
from noiseflow.progress import Progress
from recon.projection.classical import sirt
from recon.series.alignment import Alignment
from recon.series.alignment_search import KEPT, SPACING, binnings, line_integrals_of
from recon.series.matching import ITERATIONS, ROUNDS, Matcher
from recon.series.tilt_series import TiltSeries
from recon.series.views import HARMLESS

Array = NDArray[np.float64]


@described(axis="°", first_offset="°", second_offset="°", shift="px")
@dataclass(frozen=True)
class AxisRegistration:
    """The position of a second tilt axis relative to the first, and what it explains.

    The specimen is tilted about the first axis with its angles minus `first_offset`. Turned in its plane, it is tilted about the
    second axis with the angles of the second series, negated if `inverted`, plus `second_offset`.

    Attributes:
        axis: direction of the second axis in the plane of the specimen, degrees from the first axis towards −x.
        first_offset, second_offset: degrees.
        shift: (z, y, x) of the centre of the second series from that of the first, pixels.
        inverted: whether the tilt angles of the second series had the opposite sign of those of the first.
        explained: share of the variance of the images of each series that the volume of the other one predicts.
    """

    axis: float
    first_offset: float
    second_offset: float
    shift: tuple[float, float, float]
    inverted: bool
    explained: tuple[float, float]

    def of_second(self, alignment: Alignment) -> Alignment:
        """The alignment of the raw images of the second series with the shifts and angles of this registration."""
        refined = alignment.tilt_angles if alignment.refined_angles is None else alignment.refined_angles
        angles = (-refined if self.inverted else refined) + self.second_offset
        psi, theta = np.deg2rad(self.axis), np.deg2rad(angles)
        z, y, x = self.shift
        along = np.full_like(theta, y * np.cos(psi) - x * np.sin(psi))
        across = (x * np.cos(psi) + y * np.sin(psi)) * np.cos(theta) + z * np.sin(theta)
        moved = alignment.moved(-np.stack([along, across], 1))
        if abs(self.axis) < 180 and self.axis > 0:
            return replace(moved, refined_angles=angles)
        return replace(moved, tilt_axis=moved.tilt_axis + 180, refined_angles=-angles)

    @property
    def stored_axis(self) -> float:
        """The direction modulo 180°, near 90°; images of a direction near −90° are turned by 180°."""
        return self.axis % 180

    def in_words(self) -> str:
        """One line."""
        offsets = f"tilt angles {-self.first_offset:+.2f}° and {self.second_offset:+.2f}°"
        sign = ", of the opposite sign" if self.inverted else ""
        return (
            f"second axis at {self.axis:.2f}° to the first; {offsets}{sign}; shift (z, y, x) "
            f"{', '.join(f'{value:.2f}' for value in self.shift)} pixels; each series explains {self.explained[0]:.1%} and "
            f"{self.explained[1]:.1%} of the other"
        )

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return {
            "axis_degrees": self.axis,
            "angle_offsets_degrees": [-self.first_offset, self.second_offset],
            "shift_zyx_pixels": list(self.shift),
            "tilt_sign_inverted": self.inverted,
            "explained": list(self.explained),
        }


def register(
    first: TiltSeries,
    second: TiltSeries,
    *,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    widths: tuple[int, int] = (24, 80),
) -> AxisRegistration:
    """Find the rotation and shift between two aligned series of one specimen.

    Coarse volumes of both series are compared for directions of the second axis within 45° of ±90° and both signs of its tilt
    angles, by their cross-correlation. From the best ones, Gauss–Newton steps of rotation and shift minimise the differences
    between the images of each series and the projections of the volume of the other one, at widths up to 80 pixels. Volumes
    differ in their missing wedges, but images do not.

    Args:
        first, second: aligned, each with its axis along y.
        progress: called at every size.
        widths: of the images, pixels: the search compares whole volumes; the finest resolves a twentieth of its pixels.

    Raises:
        ValueError: pixel sizes or modes differ, or the volumes have little in common.
    """
    one, other = first.pixel_size, second.pixel_size
    if one and other and abs(one / other - 1) > HARMLESS["pixel size"]:
        raise ValueError(f"the two series have pixels of {one:.4g} Å and {other:.4g} Å; bin them to one size")
    if first.mode != second.mode:
        raise ValueError(f"the two series are {first.mode} and {second.mode}; give both in one --mode")
    with torch.no_grad():
        lines = [line_integrals_of(series).to(device) for series in (first, second)]
        sides = first.images.shape[1:] + second.images.shape[1:]
        sizes, found = binnings(sides, *widths), list[_Pose]()
        for done, binning in enumerate(sizes):
            pair = _Pair(lines, (first, second), binning, max(sides))
            if not found:
                found = sorted((pair.refined(pose) for pose in pair.candidates()), key=lambda pose: -pose.share)
            found = [pair.refined(found[0])]
            if progress is not None:
                progress("registering", done + 1, len(sizes), f"explained {found[0].share:.1%}")
        if found[0].share < 1 - HARMLESS["unlike"]:
            raise ValueError(
                f"the two series do not show one specimen about axes near 90° apart: the volume of each explains "
                f"{found[0].share:.0%} of the other; check the files, their tilt axes (--refine-alignment), and their pixel sizes"
            )
        return _registration(pair.settled(found[0]))


@dataclass(frozen=True)
class _Pose:
    """Coordinates (x, y, z) of the second frame are `rotation` @ (those of the first − `shift`), raw pixels."""

    rotation: Tensor
    shift: Tensor
    inverted: bool
    explained: tuple[float, float] = (-math.inf, -math.inf)

    @property
    def share(self) -> float:
        """Mean share of the variance that is explained."""
        return sum(self.explained) / 2


class _Pair:
    """Both series at one size, with a volume of each."""

    def __init__(self, lines: list[Tensor], series: tuple[TiltSeries, TiltSeries], binning: int, size: int) -> None:
        self.binning, self.size = binning, size
        self.matchers, self.images, self.seen, self.volumes = [], list[Tensor](), list[Tensor](), list[Tensor]()
        for each, of in zip(lines, series, strict=True):
            used = None if of.mask is None else torch.from_numpy(of.mask).float().to(each.device)
            matcher = Matcher(each, of.tilt_angles, binning, used, size=size // binning)
            images, seen = matcher.aligned(0.0, matcher.in_own_pixels(torch.zeros(len(each), 2, device=each.device)))
            self.matchers.append(matcher)
            self.images.append(images)
            self.seen.append(seen)
            self.volumes.append(sirt(images, matcher.projector, num_iterations=3 * ITERATIONS, used=seen))

    def candidates(self) -> list[_Pose]:
        """The directions of the second axis at which whole volumes correlate best, with their shifts."""
        found = []
        directions = np.arange(45, 136, SPACING)  # nearer to 90° than to the first axis
        for inverted in (False, True):
            second = self.volumes[1].flip(0) if inverted else self.volumes[1]
            for degrees in (*directions, *-directions):
                cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
                rotation = torch.tensor([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]).to(second)
                turned = _sampled(self.volumes[0], rotation, torch.zeros_like(rotation[0]))
                peak, move = _correlated(turned, second)
                pose = _Pose(rotation, -(rotation.T @ move) * self.binning, inverted)
                found.append((peak, pose))
        found.sort(key=lambda pair: -pair[0])
        kept: list[_Pose] = []
        for _, pose in found:
            near = (
                other.inverted == pose.inverted and float((other.rotation - pose.rotation).norm()) < math.radians(30)
                for other in kept
            )
            if not any(near):
                kept.append(pose)
        return kept[:KEPT]

    def refined(self, pose: _Pose) -> _Pose:
        """Gauss–Newton steps; the best pose that was seen."""
        best = self._judged(pose)
        for _ in range(ROUNDS):
            tried = self._judged(self._stepped(best, self._residuals))
            if tried.share <= best.share:
                break
            best = tried
        return best

    def settled(self, pose: _Pose) -> _Pose:
        """Gauss–Newton steps towards a volume of both series, which lacks less of its frequencies than that of one series."""
        volume = (self.volumes[0] + self._from_second(self.volumes[1], pose)) / 2
        for _ in range(ROUNDS):
            volume = self._of_both(volume, pose)
            pose = self._stepped(pose, partial(self._from_volume, volume))
        return self._judged(pose)

    def _from_volume(self, volume: Tensor, pose: _Pose) -> tuple[Tensor, ...]:
        """Images of the second series minus the projections of a volume in the frame of the first."""
        return (self._residual(1, self._to_second(volume, pose)),)

    def _of_both(self, volume: Tensor, pose: _Pose) -> Tensor:
        """SIRT iterations with the images of both series; a turn back stands for the adjoint of a turn."""
        first, second = self.matchers
        weights = [matcher.projector.T(seen) for matcher, seen in zip(self.matchers, self.seen, strict=True)]
        inverse = 1 / (weights[0] + self._from_second(weights[1], pose)).clamp_min(1)
        lengths = [matcher.projector(torch.ones_like(volume)).clamp_min(1) for matcher in self.matchers]
        for _ in range(ITERATIONS):
            here = (self.images[0] - first.projector(volume)) * self.seen[0] / lengths[0]
            there = (self.images[1] - second.projector(self._to_second(volume, pose))) * self.seen[1] / lengths[1]
            update = first.projector.T(here) + self._from_second(second.projector.T(there), pose)
            volume = (volume + inverse * update).clamp_min(0)
        return volume

    def _to_second(self, volume: Tensor, pose: _Pose) -> Tensor:
        """A volume in the frame of the second series."""
        found = _sampled(volume, pose.rotation, pose.shift / self.binning)
        return found.flip(0) if pose.inverted else found

    def _from_second(self, volume: Tensor, pose: _Pose) -> Tensor:
        """The reverse."""
        back = -(pose.rotation @ pose.shift) / self.binning
        return _sampled(volume.flip(0) if pose.inverted else volume, pose.rotation.T, back)

    def _residuals(self, pose: _Pose) -> tuple[Tensor, ...]:
        """Images of the first and second series minus the projections of the other's volume, and 0 where nothing is seen."""
        here, there = self._from_second(self.volumes[1], pose), self._to_second(self.volumes[0], pose)
        return self._residual(0, here), self._residual(1, there)

    def _residual(self, number: int, volume: Tensor) -> Tensor:
        predicted, images, seen = self.matchers[number].projector(volume), self.images[number], self.seen[number]
        scale = (predicted * images * seen).sum() / (predicted.square() * seen).sum().clamp_min(1e-30)
        return (images - scale * predicted) * seen

    def _judged(self, pose: _Pose) -> _Pose:
        shares = [
            float(left.square().sum() / whole) for left, whole in zip(self._residuals(pose), self._power, strict=True)
        ]
        return replace(pose, explained=(1 - shares[0], 1 - shares[1]))

    @property
    def _power(self) -> list[Tensor]:
        """The variance of the images of each series, times the number of pixels."""
        means = [(images * seen).sum() / seen.sum() for images, seen in zip(self.images, self.seen, strict=True)]
        return [
            ((images - mean).square() * seen).sum()
            for images, seen, mean in zip(self.images, self.seen, means, strict=True)
        ]

    def _stepped(self, pose: _Pose, residuals: Callable[[_Pose], tuple[Tensor, ...]]) -> _Pose:
        """A Gauss–Newton step of rotation and shift."""
        columns, start = list[Tensor](), _joined(residuals(pose))
        half = 0.5 * self.binning  # half a voxel, at the edge for a turn: the step of the numerical derivatives
        for number in range(6):
            step = torch.zeros(6, dtype=torch.float64)
            step[number] = half / (self.size / 2) if number < 3 else half
            down, up = (_joined(residuals(_moved(pose, sign * step))) for sign in (-1, 1))
            columns.append((up - down) / (2 * step[number]))
        slopes = torch.stack(columns)
        step = torch.linalg.lstsq(slopes @ slopes.T, (slopes @ start)[:, None]).solution[:, 0].cpu()
        return _moved(pose, -step)


def _joined(residuals: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([residual.flatten() for residual in residuals]).double()


def _moved(pose: _Pose, step: Tensor) -> _Pose:
    """A pose turned by a small rotation vector in the second frame, and shifted."""
    x, y, z = step[:3].tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    turn = torch.linalg.matrix_exp(cross).to(pose.rotation)
    return replace(pose, rotation=turn @ pose.rotation, shift=pose.shift + step[3:].to(pose.shift))


def _sampled(volume: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """A cube in a frame whose coordinates are `rotation` @ (those of the volume − `shift`), voxels."""
    matrix = torch.cat([rotation.T, 2 * shift[:, None] / volume.shape[0]], 1)
    grid = functional.affine_grid(matrix[None], [1, 1, *volume.shape], align_corners=False)
    # cubes are (z, y, x), and grids hold (x, y, z)
    return functional.grid_sample(volume[None, None], grid, mode="bilinear", align_corners=False)[0, 0]


def _correlated(one: Tensor, other: Tensor) -> tuple[float, Tensor]:
    """The largest normalised cross-correlation, and the shift (x, y, z) of `other` from `one`."""
    size = one.shape[0]
    spectra = [torch.fft.rfftn(each - each.mean(), s=[2 * size] * 3) for each in (one, other)]
    found = torch.fft.irfftn(spectra[1] * spectra[0].conj(), s=[2 * size] * 3)
    place = torch.tensor(np.unravel_index(int(found.argmax()), found.shape))
    place = torch.where(place >= size, place - 2 * size, place)
    norm = ((one - one.mean()).norm() * (other - other.mean()).norm()).clamp_min(1e-30)
    return float(found.max() / norm), place.flip(0).to(one)


def _registration(pose: _Pose) -> AxisRegistration:
    """The rotation as one about the first axis, one in the plane of the specimen, and one about the second axis."""
    rotation, shift = pose.rotation.double().cpu().numpy(), pose.shift.double().cpu().numpy()
    sign = 1.0 if rotation[0, 1] > 0 else -1.0
    first = math.atan2(-sign * rotation[1, 2], -sign * rotation[1, 0])
    second = math.atan2(-sign * rotation[2, 1], sign * rotation[0, 1])
    axis = sign * math.acos(max(-1.0, min(1.0, float(rotation[1, 1]))))
    cosine, sine = math.cos(first), math.sin(first)
    x, y, z = shift
    common = (-x * sine + z * cosine, y, x * cosine + z * sine)
    return AxisRegistration(
        math.degrees(axis), math.degrees(first), math.degrees(second), common, pose.inverted, pose.explained
    )
