"""What files next to a tilt series say of its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

LARGEST_ANGLE = 720
"""Largest plausible tilt angle, degrees: two full turns, more than any stage reports."""


@dataclass(frozen=True)
class TiltTable:
    """Rows of a file that describes the images of a tilt series.

    Attributes:
        angles: (row,) degrees.
        names: (row,) file of each image; empty if the table does not name them.
        sections: (row,) index of each image in its stack as written, from 0 or 1; None if the rows are all images in order.
        transforms: (row, 2, 3) of IMOD, from raw to aligned (x, y); None if the table is not an alignment.
        in_angstrom: whether the shifts of the transforms are in Å, not pixels of the stack.
        image_shape: (y, x) of the images that the transforms refer to; None if unknown.
        pixel_size: Å, or None if unknown.
        tilt_axis: degrees from y towards −x, or None if unknown.
        excluded: rows to leave out, from 0.
        x_tilt: degrees by which the specimen is turned about x, as IMOD's ``XAXISTILT``: z of a flat specimen rises with y.
        acquired: (row,) dose before each image, or its time, in any unit; None if unknown.
    """

    angles: NDArray[np.float64]
    names: tuple[str, ...] = ()
    sections: NDArray[np.int64] | None = None
    transforms: NDArray[np.float64] | None = None
    in_angstrom: bool = False
    image_shape: tuple[int, int] | None = None
    pixel_size: float | None = None
    tilt_axis: float | None = None
    excluded: tuple[int, ...] = ()
    x_tilt: float = 0.0
    acquired: NDArray[np.float64] | None = None

    def rows(self, chosen: Sequence[int]) -> TiltTable:
        """Some of the rows, in this order."""
        order = np.asarray(chosen, dtype=np.int64)
        return replace(
            self,
            angles=self.angles[order],
            names=tuple(self.names[row] for row in order) if self.names else (),
            sections=None if self.sections is None else self.sections[order],
            transforms=None if self.transforms is None else self.transforms[order],
            acquired=None if self.acquired is None else self.acquired[order],
            excluded=tuple(place for place, row in enumerate(order) if row in self.excluded),
        )


def rotations(tilt_axes: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """(row, 2, 3) transforms of IMOD for images whose axis and centre were found in the raw images.

    Args:
        tilt_axes: (row,) degrees from y towards −x.
        shifts: (row, 2) shift (x, y) of the aligned centre from the raw centre, pixels.
    """
    theta = np.deg2rad(tilt_axes)
    matrices = np.stack([np.cos(theta), np.sin(theta), -np.sin(theta), np.cos(theta)], 1).reshape(-1, 2, 2)
    return np.concatenate([matrices, -matrices @ shifts[:, :, None]], 2)
