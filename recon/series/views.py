"""What must not change a volume: the order of the tilts, full turns of their angles, doubled tilts, a constant added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from recon.series.tilt_series import TiltSeries

_TWINS = 0.1  # of the mean step: tilts so near to each other show the same view
_SAMPLE = 100_000


def in_order(tilt_series: TiltSeries) -> TiltSeries:
    """The series by rising angle, in [−180°, 180°] where an angle was outside; tilts of equal angle keep their order."""
    angles = tilt_series.tilt_angles
    if np.abs(angles).max() > 180:
        angles = (angles + 180) % 360 - 180
        tilt_series = replace(tilt_series, tilt_angles=angles)
    order = np.argsort(angles, kind="stable")
    return tilt_series if (np.diff(order) == 1).all() else tilt_series.select(order)


def view_numbers(tilt_angles: NDArray[np.float64]) -> NDArray[np.int64]:
    """(tilt,) the number of each tilt's view, from one side of the missing wedge to the other; twins have the same.

    Images half a turn apart are mirror images of each other, and twins too.

    Args:
        tilt_angles: (tilt,) degrees.
    """
    half_turn = np.round(tilt_angles % 180, 6) % 180
    values, back = np.unique(half_turn, return_inverse=True)
    steps = np.diff(np.r_[values, values[0] + 180])
    centres = np.abs((values + steps / 2) % 180 - 90)  # of equal steps, the one about 90° counts as the wedge
    wedge = max(range(len(values)), key=lambda i: (round(steps[i], 4), -round(centres[i], 4)))
    rolled = np.roll(steps, -wedge - 1)[:-1]
    apart = rolled > _TWINS * rolled.sum() / len(tilt_angles)
    numbers = np.roll(np.r_[0, np.cumsum(apart)], wedge + 1)
    return np.asarray(numbers[back], dtype=np.int64)


def every_nth_view(tilt_angles: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """(tilt,) True for one view in `count`, spread evenly from the middle view to both sides, each with all its twins.

    Args:
        tilt_angles: (tilt,) degrees, in any order.
        count: at least two.
    """
    numbers = view_numbers(tilt_angles)
    return np.asarray(np.abs(numbers - numbers.max() / 2).astype(np.int64) % count == count // 2)


def first_copies(tilt_series: TiltSeries) -> NDArray[np.int64]:
    """(tilt,) the number of the first tilt of equal angle, image and mask: copies to the last pixel, which say nothing new.

    Args:
        tilt_series: by rising angle.
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


def dark_level(tilt_series: TiltSeries) -> float:
    """The dark level of linear images, that of the darkest hundredth of their pixels; zero for bright field.

    Noise models that count electrons begin to count near zero without it, and what a fit chooses does not depend on a constant
    added.
    """
    return level_of(tilt_series, quantile=0.01)


def lowered_by(tilt_series: TiltSeries, level: float) -> TiltSeries:
    """Images minus a level, subtracted in float64 and kept in float32; the series itself where the level is zero."""
    if not level:
        return tilt_series
    images = tilt_series.images
    lowered = ((image.astype(np.float64) - level).astype(np.float32) for image in images)
    kept = mapped.mapped_copy(lowered, images.shape, np.float32, in_memory=mapped.IN_MEMORY)
    return tilt_series.with_images(kept, tilt_series.mask)


def without_level(tilt_series: TiltSeries) -> tuple[TiltSeries, float]:
    """Linear images minus their median pixel value, in float32, and that value: a large constant costs no digits so.

    Bright-field images keep their zero, which means something: the level is zero there.
    """
    images, level = tilt_series.images, level_of(tilt_series)
    if not level:
        return replace(tilt_series, images=np.asarray(images, dtype=np.float32)), 0.0
    return lowered_by(tilt_series, level), level


def level_of(tilt_series: TiltSeries, *, quantile: float = 0.5) -> float:
    """The median of the used pixel values of linear images, or that at another quantile; zero for bright field."""
    images, mask = tilt_series.images, tilt_series.mask
    if tilt_series.mode != "linear":
        return 0.0
    step = max(1, images.size // (_SAMPLE * len(images)))
    used = images if mask is None else (image[part] for image, part in zip(images, mask, strict=True))
    sample = np.concatenate([np.sort(image, axis=None)[::step] for image in used]).astype(np.float64)
    return float(np.quantile(sample, quantile, method="nearest"))
