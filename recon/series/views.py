"""Invariances of a reconstruction: order of the tilts, full turns of angles, duplicate tilts, an added constant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from recon.projection.classical import directions
from recon.series.tilt_series import TiltSeries

HARMLESS: dict[str, float] = {
    # degrees: files round directions, and stages repeat tilts to 0.1
    "direction": 0.02,
    "tilt": 0.3,
    # of the mean step: tilts this close show the same view
    "view": 0.1,
    # degrees from y: a volume with an axis this close still explains its images
    "axis along y": 3.0,
    # relative: rounding in headers, and a masked part of a pixel that changes its value by less than the noise
    "pixel size": 0.01,
    "masked part": 0.01,
    # of a row that may be hidden in an image, as its edges are mostly vacuum
    "hidden part": 0.3,
    # of the image edge: stages return to a tenth of the field of view
    "shift": 0.25,
    # of the images: shares that right and inverted contrast explain differ by at least 0.12 in phantoms and real series, by 0.04
    # at noise of three times the contrast, and by 0.003 in one series with shifted images
    "contrast": 0.05,
    # where they are explained alike, as in raw images whose shifts are not known: place of the median in the range of the values,
    # below which most pixels are background; that of symmetric noise is 0.5
    "background": 0.3,
    # degrees from the plane of the stage: lamellae of ion mills lie up to 20° off
    "own tilt": 23.0,
    # line integral at the sides of the images, relative to the mean
    "sides": 0.4,
    # of the specimen: unspoilt phantoms stay below 2.2 %, and the aligned needle, whose profile leaves the images, at 2.4 %; a
    # change of 3 % moves the edge of 48 pixels by a third of a pixel
    "size": 0.03,
    # of the beam: constant ones have an apparent drift of 0.004 to 0.035, from noise and from material outside the volume
    "beam": 0.04,
    # from tilt to tilt in bright field, where it adds to the mass of all pixels: 0.0099 at most without a change (24 series of 32
    # pixels, 30 and 300 counts), which chance explains; changes of 0.03 made films and boxes bad
    "beam on vacuum": 0.01,
    # nats per pixel of a tilt beyond its neighbours
    "excess": 0.4,
    # of the tilts: if more are inconsistent, the comparison is wrong, not the tilts
    "inconsistent": 0.1,
    # ratio of occupied shares: volumes of one object with equally good axes differ by up to 1.1
    "occupied": 1.2,
    # of the variance that another series leaves: unrelated specimens predict each other's images to less than a third, as all are
    # bright in the middle
    "unlike": 0.6,
    # mean counts per pixel, below which noise is a third of the signal and more, and hides the error of the nearest pixel
    "counts": 10,
}
"""What is harmless, or counts as equal, in a series."""
AROUND = 9
"""Tilts around a tilt with which it is compared; fewer show no course."""
TILE = 4  # pixels, within which detectors correlate their noise


def angles_in_words(angles: NDArray[np.float64]) -> str:
    """The first few of some angles, degrees, for a message."""
    return ", ".join(f"{angle:g}°" for angle in angles[:8]) + (", …" if len(angles) > 8 else "")


def in_order(tilt_series: TiltSeries) -> TiltSeries:
    """The series sorted by angle, mapped to [−180°, 180°] if an angle was outside; the sort is stable."""
    angles = tilt_series.tilt_angles
    if np.abs(angles).max() > 180:
        angles = (angles + 180) % 360 - 180
        tilt_series = replace(tilt_series, tilt_angles=angles)
    order = tilt_series.rising
    return tilt_series if (np.diff(order) == 1).all() else tilt_series.select(order)


@dataclass(frozen=True)
class Directions:
    """Tilts as directions modulo 180°: images 180° apart are mirror images of each other.

    Attributes:
        angles: (tilt,) degrees, within 180° from one side of the missing wedge to the other.
        mirrored: (tilt,) whether an image at this direction is the given image mirrored along u.
        order: (tilt,) indices of the tilts by rising direction.
    """

    angles: NDArray[np.float64]
    mirrored: NDArray[np.bool_]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, tilt_angles: NDArray[np.float64]) -> Directions:
        """The directions of tilt angles (tilt,), degrees; as few images as possible are mirrored."""
        values, back, steps = directions(tilt_angles)
        start = values[(_wedge(values, steps) + 1) % len(values)]
        angles = start + (values[back] - start) % 180
        half_turns = np.round((tilt_angles - angles) / 180).astype(np.int64)
        usual = int(np.median(half_turns))
        mirrored = (half_turns - usual) % 2 == 1
        if mirrored.mean() > 0.5:
            usual, mirrored = usual + 1, ~mirrored
        angles = angles + 180 * usual
        return cls(angles, mirrored, np.argsort(angles, kind="stable"))

    @property
    def span(self) -> float:
        """Degrees between the outer directions."""
        return float(np.ptp(self.angles))

    def arranged(self, images: NDArray[Any]) -> NDArray[Any]:
        """Images (tilt, y, u) by rising direction, mirrored where necessary."""
        return np.asarray(np.where(self.mirrored[:, None, None], images[:, :, ::-1], images)[self.order])


def _wedge(values: NDArray[np.float64], steps: NDArray[np.float64]) -> int:
    """Index of the last direction before the widest gap; if steps are equal, the one around 90° is taken as the wedge."""
    centres = np.abs((values + steps / 2) % 180 - 90)
    return max(range(len(values)), key=lambda i: (round(float(steps[i]), 4), -round(float(centres[i]), 4)))


def view_numbers(tilt_angles: NDArray[np.float64]) -> NDArray[np.int64]:
    """(tilt,) index of each tilt's view, from one side of the missing wedge to the other; duplicates have the same index.

    Images 180° apart are mirror images of each other and count as duplicates.

    Args:
        tilt_angles: (tilt,) degrees.
    """
    values, back, steps = directions(tilt_angles)
    wedge = _wedge(values, steps)
    steps = np.roll(steps, -wedge - 1)[:-1]
    apart = steps > HARMLESS["view"] * steps.sum() / len(tilt_angles)
    return np.asarray(np.roll(np.r_[0, np.cumsum(apart)], wedge + 1)[back], dtype=np.int64)


def first_copies(tilt_series: TiltSeries) -> NDArray[np.int64]:
    """(tilt,) index of the first tilt with equal angle, image and mask; exact copies contain no new information.

    Args:
        tilt_series: sorted by angle.
    """
    angles, images, used = tilt_series.tilt_angles, tilt_series.images, tilt_series.mask
    numbers = np.arange(len(angles))
    for number in range(1, len(angles)):
        for other in range(number - 1, -1, -1):
            if angles[other] != angles[number]:
                break
            same_mask = used is None or np.array_equal(used[other], used[number])
            if same_mask and np.array_equal(images[other], images[number]):
                numbers[number] = numbers[other]
                break
    return numbers


def lowered_by(tilt_series: TiltSeries, level: float) -> TiltSeries:
    """Images minus a level, subtracted in float64 and stored in float32; the series itself if the level is zero."""
    if not level:
        return tilt_series
    images = tilt_series.images
    lowered = ((image.astype(np.float64) - level).astype(np.float32) for image in images)
    return tilt_series.with_images(mapped.mapped_copy(lowered, images.shape, np.float32), tilt_series.mask)


def without_level(tilt_series: TiltSeries) -> tuple[TiltSeries, float]:
    """Linear images minus their median, in float32, and the median, so that a large constant does not reduce the precision.

    For bright-field images, whose zero is meaningful, the level is zero.
    """
    images, level = tilt_series.images, level_of(tilt_series)
    if not level:
        return replace(tilt_series, images=np.asarray(images, dtype=np.float32)), 0.0
    return lowered_by(tilt_series, level), level


def level_of(tilt_series: TiltSeries, *, quantile: float = 0.5, most: int = 500_000) -> float:
    """The median, or another quantile, of the used pixel values of linear images, of at `most` so many, so that memory does not
    grow with the series; zero for bright field."""
    if tilt_series.mode != "linear":
        return 0.0
    step = max(1, tilt_series.images.size // most)
    sample = np.concatenate([np.sort(part)[::step].copy() for part in tilt_series.values()])  # views keep whole images
    return float(np.quantile(sample, quantile, method="nearest"))
