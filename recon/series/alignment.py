"""Alignment of a tilt series: tilt axis, image shifts and stretches, and their application so that the axis is along y."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform

from noiseflow.described import described
from noiseflow.io import mapped
from recon.series.evidence import Evidence
from recon.series.masks import filled
from recon.series.tilt_series import TiltSeries
from recon.series.views import HARMLESS, angles_in_words

_OUTSIDE = "parts of them are outside the raw images and are left out of the fit"


@described(
    tilt_axis="°", shifts="px", tilt_angles="°", stretches="px/px", refined_angles="°", pixel_size="Å", x_tilt="°"
)
@dataclass(frozen=True)
class Alignment:
    """The transformation from aligned to raw images: a stretch, a rotation about the centre, then a shift.

    Attributes:
        tilt_axis: degrees from y towards −x, anticlockwise if y points up (IMOD's rotation angle).
        shifts: (tilt, 2) shift (y, x) of the aligned centre from the raw centre, pixels of the raw images.
        tilt_angles: (tilt,) degrees, as in the raw series; other series are joined by them.
        evidence: evidence for this axis, then for other candidates, best first; empty if the axis was given without a search.
        stretches: (tilt, 2, 2) linear map of aligned positions (y, x) before the rotation, such as a magnification; None for
            the identity.
        refined_angles: (tilt,) degrees to use in place of `tilt_angles`; None if they did not change.
        image_shape: (y, x) of the raw images; None if unknown. Shifts are scaled for images of another binning.
        pixel_size: Å, of the raw images; None if unknown.
        x_tilt: that of the aligned series if it is not 0, see `TiltSeries`.

    Example:
        >>> import numpy as np, recon
        >>> alignment = recon.Alignment(85.0, np.zeros((3, 2)), np.array([-30.0, 0.0, 30.0]))
        >>> series = recon.TiltSeries(np.random.default_rng(0).random((3, 8, 12)), [30.0, 0.0, -30.0], mode="linear")
        >>> alignment.joined(series).apply(series).images.shape
        (3, 12, 8)
    """

    tilt_axis: float
    shifts: NDArray[np.float64]
    tilt_angles: NDArray[np.float64]
    evidence: tuple[Evidence, ...] = ()
    stretches: NDArray[np.float64] | None = None
    refined_angles: NDArray[np.float64] | None = None
    image_shape: tuple[int, int] | None = None
    pixel_size: float | None = None
    x_tilt: float = 0.0

    @classmethod
    def unshifted(cls, tilt_series: TiltSeries, tilt_axis: float = 0.0) -> Alignment:
        """The alignment of raw images about an axis through their centres, degrees from y towards −x."""
        height, width = tilt_series.images.shape[1:]
        shifts, size = np.zeros((tilt_series.num_tilts, 2)), tilt_series.pixel_size
        return cls(tilt_axis, shifts, tilt_series.tilt_angles, image_shape=(height, width), pixel_size=size)

    @classmethod
    def of_transforms(
        cls, transforms: NDArray[np.float64], tilt_angles: NDArray[np.float64], **known: Any
    ) -> Alignment:
        """The alignment of IMOD transforms (tilt, 2, 3), from raw to aligned (x, y), see `noiseflow.io.read_transforms`.

        Args:
            transforms: one for each tilt.
            tilt_angles: (tilt,) degrees.
            **known: further attributes.

        Raises:
            ValueError: the numbers of transforms and angles differ.
        """
        if len(transforms) != len(tilt_angles):
            raise ValueError(
                f"there are {len(transforms)} transforms and {len(tilt_angles)} tilt angles; give the .xf of this series"
            )
        back = np.linalg.inv(transforms[:, ::-1, 1::-1])
        shifts = -np.einsum("tij,tj->ti", back, transforms[:, ::-1, 2])
        mean = back.mean(0)
        axis = float(np.rad2deg(np.arctan2(mean[0, 1] - mean[1, 0], mean[0, 0] + mean[1, 1])))
        stretches = _rotation(axis).T @ back
        plain = np.allclose(stretches, np.eye(2), atol=1e-6)  # files have seven digits
        return cls(axis, shifts, tilt_angles, stretches=None if plain else stretches, **known)

    @property
    def transforms(self) -> NDArray[np.float64]:
        """(tilt, 2, 3) transforms of IMOD, from raw to aligned (x, y)."""
        forward = np.linalg.inv(self._back)
        moves = -np.einsum("tij,tj->ti", forward, self.shifts)
        return np.concatenate([forward[:, ::-1, ::-1], moves[:, ::-1, None]], 2)

    @property
    def _back(self) -> NDArray[np.float64]:
        """(tilt, 2, 2) linear part of the map from aligned to raw positions (y, x)."""
        back = np.broadcast_to(_rotation(self.tilt_axis), (len(self.shifts), 2, 2))
        return back if self.stretches is None else back @ self.stretches

    def scaled(self, factor: float) -> Alignment:
        """The alignment of the same images with `factor` times as many pixels along each edge."""
        shape = self.image_shape and (round(self.image_shape[0] * factor), round(self.image_shape[1] * factor))
        size = None if self.pixel_size is None else self.pixel_size / factor
        return replace(self, shifts=self.shifts * factor, image_shape=shape, pixel_size=size)

    def moved(self, moves: NDArray[np.float64]) -> Alignment:
        """The alignment whose images are shifted: a position p (y, x) in them shows what was at p + `moves`, (tilt, 2)."""
        return replace(self, shifts=self.shifts + np.einsum("tij,tj->ti", self._back, moves))

    def order_of(self, tilt_series: TiltSeries) -> list[int]:
        """For each tilt of a series, the index of the tilt of this alignment with the same angle; full turns do not matter.
        Raises ValueError if a tilt of the series is not in the alignment."""
        angles = tilt_series.tilt_angles
        steps = np.diff(np.unique(np.round(self.tilt_angles, 2)))
        near = min([HARMLESS["tilt"], *steps / 3])  # no more than a third of the smallest step
        left, order, missing = list(range(len(self.tilt_angles))), list[int](), list[float]()
        for angle in angles:
            apart = [abs(math.remainder(self.tilt_angles[k] - angle, 360)) for k in left]
            if not apart or min(apart) > near:
                missing.append(angle)
            else:
                order.append(left.pop(int(np.argmin(apart))))
        if missing:
            raise ValueError(
                f"the alignment has no tilt at {angles_in_words(np.array(missing))}: it is of {len(self.tilt_angles)} tilts from "
                f"{self.tilt_angles.min():g}° to {self.tilt_angles.max():g}°, and the series has {len(angles)}; give the "
                "alignment of these tilts, or --exclude-views"
            )
        return order

    def joined(self, tilt_series: TiltSeries) -> Alignment:
        """The alignment of another series of the same tilts, such as another channel: joined by angle, scaled to its binning.
        Raises ValueError if a tilt of the series is not in the alignment, or the images show another field of view."""
        order = self.order_of(tilt_series)
        stretches, refined = (None if each is None else each[order] for each in (self.stretches, self.refined_angles))
        here = replace(
            self,
            shifts=self.shifts[order],
            tilt_angles=tilt_series.tilt_angles,
            stretches=stretches,
            refined_angles=refined,
        )
        return here.scaled(self._factor(tilt_series))

    def _factor(self, tilt_series: TiltSeries) -> float:
        """How many pixels of a series correspond to one pixel of the aligned images."""
        size, own = tilt_series.images.shape[1:], self.image_shape
        by_size = None if not (tilt_series.pixel_size and self.pixel_size) else self.pixel_size / tilt_series.pixel_size
        if own is None:
            return by_size or 1.0
        factors = np.array(size) / np.array(own)
        near = max(HARMLESS["pixel size"], 1 / min(*size, *own))  # incomplete blocks lose less than one pixel
        odd = abs(factors[0] / factors[1] - 1) > near
        factor = 1.0 if size == own else float(factors.mean())
        if odd or (by_size is not None and abs(by_size / factor - 1) > near):
            sizes = "" if by_size is None else f" of {self.pixel_size:.4g} Å and {tilt_series.pixel_size:.4g} Å"
            raise ValueError(
                f"the alignment is of images of {own[0]} x {own[1]} pixels, and these are {size[0]} x {size[1]}{sizes}: not the "
                "same field of view with another binning; give the alignment of these images"
            )
        return factor

    def apply(self, tilt_series: TiltSeries, *, shape: tuple[int, int] | None = None) -> TiltSeries:
        """Align a series so that the axis is along y through the centre; regions outside the raw images are masked.

        Images are interpolated once, with cubic splines, which correlates the noise of neighbouring pixels. Whole numbers with a
        mean below ten are copied from the nearest pixel instead, because interpolated counts are not Poisson. If the axis is
        within 45° of x, height and width are swapped. Without rotation and fractional shifts, pixel values do not change. Large
        series are written to a temporary file.

        Args:
            tilt_series: the raw series, with its tilts in the order of this alignment; see `joined`.
            shape: (y, x) of the aligned images; by default that of the raw images.

        Raises:
            OSError: the disk does not have enough space for that file.
            ValueError: the numbers of shifts and tilts differ, or an image is moved out of view.
        """
        if self.shifts.shape != (tilt_series.num_tilts, 2):
            raise ValueError(f"{len(self.shifts)} shifts do not match {tilt_series.num_tilts} tilts")
        raw, theta = tilt_series.images.shape[1:], np.deg2rad(self.tilt_axis)
        upright = abs(np.cos(theta)) >= abs(np.sin(theta))
        size = (tilt_series.num_tilts, *(shape or (raw if upright else raw[::-1])))
        images, mask = (mapped.temporary_map(size, kind) for kind in (np.float32, np.bool_))
        given, counts = tilt_series.images.dtype, False
        if np.issubdtype(given, np.integer) and min(image.min() for image in tilt_series.images) >= 0:
            # few counts per pixel, as in element maps
            counts = bool(np.mean([image.mean() for image in tilt_series.images]) < HARMLESS["counts"])
        for number, (image, back) in enumerate(zip(tilt_series.images, self._back, strict=True)):
            use = np.ones(image.shape, np.bool_) if tilt_series.mask is None else tilt_series.mask[number]
            images[number], mask[number] = _moved(image, use, back, self.shifts[number], size[1:], nearest=counts)
        if not mask.any((1, 2)).all():
            raise ValueError("an image was moved out of view entirely; give --tilt-axis, or remove --refine-alignment")
        if not np.issubdtype(given, np.floating) and all(np.array_equal(image, np.round(image)) for image in images):
            images = mapped.mapped_copy((image.astype(given) for image in images), size, given)
        if mask.mean() < 0.98:
            warnings.warn(f"aligned images show {mask.mean():.0%} of their frame: {_OUTSIDE}", stacklevel=2)
        angles = tilt_series.tilt_angles if self.refined_angles is None else self.refined_angles
        part = None if mask.all() else mask
        turned = self.x_tilt or tilt_series.x_tilt
        return replace(tilt_series, images=images, mask=part, tilt_axis=None, tilt_angles=angles, x_tilt=turned)

    @property
    def residual(self) -> float | None:
        """Unexplained share of the variance of tilts in contiguous gaps, given the other tilts; None without a search."""
        return self.evidence[0].residual if self.evidence else None

    @property
    def margin(self) -> float | None:
        """Lead of the axis over the best other direction, in standard errors; None if there is no other."""
        return self.evidence[0].lead_over(self.evidence[1]) if len(self.evidence) > 1 else None

    @property
    def axis_offset(self) -> float:
        """Distance of the tilt axis from the raw centre, pixels: the shift not explained by the position of the object."""
        theta, axis = np.deg2rad(self.tilt_angles), np.deg2rad(self.tilt_axis)
        across = self.shifts @ np.array([np.sin(axis), np.cos(axis)])
        design = np.stack([np.ones_like(theta), np.cos(theta), np.sin(theta)], 1)
        return float(np.linalg.lstsq(design, across, rcond=None)[0][0])

    def in_words(self) -> str:
        """One line."""
        largest, rms = np.abs(self.shifts).max(), np.sqrt(np.mean((self.shifts - self.shifts.mean(0)) ** 2))
        words = (
            f"aligned: tilt axis {self.tilt_axis:.2f}°, {self.axis_offset:.2f} pixels off the middle; shifts up to "
            f"{largest:.1f} pixels, {rms:.2f} rms"
        )
        if self.residual is not None:
            words += f"; {1 - self.residual:.1%} of held-out gaps of tilts explained"
        if self.stretches is not None:
            sizes = np.sqrt(np.abs(np.linalg.det(self.stretches)))
            words += f"; size of the specimen from {sizes.min():.3f} to {sizes.max():.3f}"
        if self.margin is not None:
            words += f", {1 - self.evidence[1].residual:.1%} at {self.evidence[1].axis:.1f}°"
        return words

    def choices(self) -> dict[str, float | str]:
        """Values for a table of results."""
        found: dict[str, float | str] = {"tilt axis (°)": f"{self.tilt_axis:.2f}"}
        if self.residual is not None:
            found["axis offset (pixels)"] = f"{self.axis_offset:.2f}"
            found["largest shift (pixels)"] = f"{np.abs(self.shifts).max():.2f}"
        if self.stretches is not None:
            sizes = np.sqrt(np.abs(np.linalg.det(self.stretches)))
            found["size of the specimen"] = f"{sizes.min():.3f} to {sizes.max():.3f}"
        return found

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return {
            "tilt_axis_degrees": self.tilt_axis,
            "axis_offset_pixels": self.axis_offset,
            "tilt_angles_degrees": self.tilt_angles.tolist(),
            "shifts_yx_pixels": self.shifts.tolist(),
            "stretches_yx": None if self.stretches is None else self.stretches.tolist(),
            "refined_angles_degrees": None if self.refined_angles is None else self.refined_angles.tolist(),
            "image_shape_yx": self.image_shape,
            "pixel_size_angstrom": self.pixel_size,
            "x_tilt_degrees": self.x_tilt,
            "unexplained_variance": self.residual,
            "margin_standard_errors": self.margin,
            "candidates": [evidence.as_dict() for evidence in self.evidence],
        }


def _rotation(degrees: float) -> NDArray[np.float64]:
    """Matrix from aligned to raw positions (y, x); exact for right angles."""
    theta = np.deg2rad(degrees)
    matrix = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    return np.round(matrix) if degrees % 90 == 0 else matrix


def _moved(
    image: NDArray[Any],
    use: NDArray[np.bool_],
    back: NDArray[np.float64],
    shift: NDArray[np.float64],
    shape: tuple[int, ...],
    *,
    nearest: bool,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """An aligned image and its mask."""
    start = (np.array(image.shape) - 1) / 2 + shift - back @ ((np.array(shape) - 1) / 2)
    seen = affine_transform(use.astype(np.float32), back, start, output_shape=shape, order=1, cval=0.0)
    mask = seen > 1 - HARMLESS["masked part"]
    # quarter turns and shifts by whole pixels: values are copied
    exact = nearest or (np.array_equal(back, np.round(back)) and np.array_equal(start, np.round(start)))
    source = image.astype(np.float64)
    moved = affine_transform(
        source, back, start, output_shape=shape, order=0 if exact else 3, mode="nearest", output=np.float32
    )
    return filled(moved, mask), mask
