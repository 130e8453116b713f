"""Alignment of a tilt series: tilt axis and image shifts, and their application so that the axis is along y."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.described import described
from noiseflow.io import mapped
from recon.series.evidence import Evidence
from recon.series.tilt_series import TiltSeries, filled

_OUTSIDE = "parts of them are outside the raw images and are left out of the fit"


@described(tilt_axis="°", shifts="px", tilt_angles="°")
@dataclass(frozen=True)
class Alignment:
    """The transformation from aligned to raw images: a rotation about the centre, then a shift.

    Attributes:
        tilt_axis: degrees from y towards −x, anticlockwise if y points up (IMOD's rotation angle).
        shifts: (tilt, 2) shift (y, x) of the aligned centre from the raw centre, pixels of the raw images.
        tilt_angles: (tilt,) degrees.
        evidence: evidence for this axis, then for other candidates, best first; empty if the axis was given without a search.
    """

    tilt_axis: float
    shifts: NDArray[np.float64]
    tilt_angles: NDArray[np.float64]
    evidence: tuple[Evidence, ...] = ()

    def apply(self, tilt_series: TiltSeries) -> TiltSeries:
        """Align a series so that the axis is along y through the centre; regions outside the raw images are masked.

        Images are interpolated once, with cubic splines, which correlates the noise of neighbouring pixels. If the axis is
        within 45° of x, height and width are swapped. Without rotation and fractional shifts, pixel values do not change. Large
        series are written to a temporary file.

        Raises:
            OSError: the disk does not have enough space for that file.
            ValueError: the numbers of shifts and tilts differ, or an image is moved out of view.
        """
        if self.shifts.shape != (tilt_series.num_tilts, 2):
            raise ValueError(f"{len(self.shifts)} shifts do not match {tilt_series.num_tilts} tilts")
        shape = (tilt_series.num_tilts, *self._shape(tilt_series.images.shape[1:]))
        images, mask = (
            mapped.temporary_map(shape, kind, in_memory=mapped.IN_MEMORY) for kind in (np.float32, np.bool_)
        )
        for number, (image, shift) in enumerate(zip(tilt_series.images, self.shifts, strict=True)):
            use = np.ones(image.shape, np.bool_) if tilt_series.mask is None else tilt_series.mask[number]
            images[number], mask[number] = self._moved(image, use, shift)
        if not mask.any((1, 2)).all():
            raise ValueError("an image was moved out of view entirely; give --tilt-axis, or remove --refine-alignment")
        given = tilt_series.images.dtype
        if not np.issubdtype(given, np.floating) and all(np.array_equal(image, np.round(image)) for image in images):
            images = mapped.mapped_copy(
                (image.astype(given) for image in images), shape, given, in_memory=mapped.IN_MEMORY
            )
        if mask.mean() < 0.98:
            warnings.warn(f"aligned images show {mask.mean():.0%} of their frame: {_OUTSIDE}", stacklevel=2)
        return replace(tilt_series, images=images, mask=None if mask.all() else mask, tilt_axis=None)

    def _shape(self, raw: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of aligned images."""
        theta = np.deg2rad(self.tilt_axis)
        return raw if abs(np.cos(theta)) >= abs(np.sin(theta)) else raw[::-1]

    def _moved(
        self, image: NDArray[Any], use: NDArray[np.bool_], shift: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        from scipy.ndimage import affine_transform

        theta, shape = np.deg2rad(self.tilt_axis), self._shape(image.shape)
        back = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
        if self.tilt_axis % 90 == 0:
            back = np.round(back)
        start = (np.array(image.shape) - 1) / 2 + shift - back @ ((np.array(shape) - 1) / 2)
        seen = affine_transform(use.astype(np.float32), back, start, output_shape=shape, order=1, cval=0.0)
        mask = seen > 0.99
        exact = self.tilt_axis % 90 == 0 and np.array_equal(
            start, np.round(start)
        )  # whole-pixel shift: values are copied
        moved = affine_transform(
            image.astype(np.float64),
            back,
            start,
            output_shape=shape,
            order=0 if exact else 3,
            mode="nearest",
            output=np.float32,
        )
        return filled(moved, mask), mask

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
        if self.margin is not None:
            words += f", {1 - self.evidence[1].residual:.1%} at {self.evidence[1].axis:.1f}°"
        return words

    def choices(self) -> dict[str, float | str]:
        """Values for a table of results."""
        found: dict[str, float | str] = {"tilt axis (°)": f"{self.tilt_axis:.2f}"}
        if self.residual is not None:
            found["axis offset (pixels)"] = f"{self.axis_offset:.2f}"
            found["largest shift (pixels)"] = f"{np.abs(self.shifts).max():.2f}"
        return found

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return {
            "tilt_axis_degrees": self.tilt_axis,
            "axis_offset_pixels": self.axis_offset,
            "tilt_angles_degrees": self.tilt_angles.tolist(),
            "shifts_yx_pixels": self.shifts.tolist(),
            "unexplained_variance": self.residual,
            "margin_standard_errors": self.margin,
            "candidates": [evidence.as_dict() for evidence in self.evidence],
        }
