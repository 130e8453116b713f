"""Tilts to hold out: the groups whose tilts are predicted by a volume of the others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.series.views import Directions, view_numbers

# degrees: closer tilts predict each other for any axis and any volume. Gaps of 15 give four series of blobs (28² and 32²) the
# same tilt axes within 0.3°, and the same least lead over other axes, 4.3 standard errors
GAP = 12.0


@dataclass(frozen=True)
class Holdout:
    """Groups of tilts, numbered by direction; images of one direction, and those 180° apart, are in one group.

    Every question whether the other tilts predict this one is asked of these groups. Contiguous gaps test the geometry, because
    only a volume predicts across a gap. Evenly spaced views test the smoothness of a volume, whose error in a gap is mostly that
    of the missing directions.

    Attributes:
        groups: (tilt,) number of the group of each tilt.
    """

    groups: NDArray[np.int64]

    @classmethod
    def gaps(cls, tilt_angles: NDArray[np.float64], degrees: float = GAP, *, fewest: int = 5) -> Holdout:
        """Contiguous ranges of directions, at least five: three between the outer two, which are extrapolated, have a spread.

        Args:
            tilt_angles: (tilt,) degrees, in any order.
            degrees: width of a range.
        """
        values, back = np.unique(np.round(Directions.of(tilt_angles).angles, 3), return_inverse=True)
        span = float(values[-1] - values[0])
        count = int(max(fewest, round(span / degrees)))
        group = np.minimum(((values - values[0]) / max(span, 1e-30) * count).astype(np.int64), count - 1)
        return cls(group[back])

    @classmethod
    def views(cls, tilt_angles: NDArray[np.float64], every: int) -> Holdout:
        """Evenly spaced views: one in `every` is group 1, from the middle to both sides, and the others are group 0.

        Views are held out with all their duplicates, because a remaining duplicate would reveal the noise.

        Args:
            tilt_angles: (tilt,) degrees, in any order.
            every: at least two.
        """
        numbers = view_numbers(tilt_angles)
        out = np.abs(numbers - numbers.max() / 2).astype(np.int64) % every == every // 2
        return cls(out.astype(np.int64))

    @classmethod
    def two_gaps(cls, tilt_angles: NDArray[np.float64]) -> Holdout:
        """Two contiguous gaps, a third of the range apart, each a tenth of the range and three tilts wide or more (those of nine
        tilts share one), or both two thirds of fewer tilts: groups 1 and 2; the others are group 0, empty for two tilts."""
        directions, groups = Directions.of(tilt_angles), np.zeros(len(tilt_angles), dtype=np.int64)
        for number in (1, 2):
            distance = np.abs(directions.angles - directions.angles.min() - number / 3 * directions.span)
            nearest = float(np.sort(distance)[min(2, max(0, len(distance) // 3 - 1))])
            groups[distance <= max(directions.span / 20, nearest)] = number
        return cls(groups)

    @classmethod
    def as_missing(cls, tilt_angles: NDArray[np.float64], share: float) -> Holdout:
        """Tilts whose directions are as hard to predict as those that no tilt shows. They are not in group 0.

        Beside a missing wedge, these are the tilts within half the share of the range from either end, groups 1 and 2: only a
        volume that is right in the wedge predicts them well. If the widest gap is no wider than two steps, these are evenly
        spaced views, group 1: on a real series of 0 to 179°, fields that fill a gap best predict the tilts between others worst.

        Args:
            tilt_angles: (tilt,) degrees, in any order.
            share: of the range.

        Raises:
            ValueError: there are no other tilts.
        """
        directions = Directions.of(tilt_angles)
        place = directions.angles - directions.angles.min()
        views, steps = cls.views(tilt_angles, round(1 / share)), np.diff(np.unique(np.round(place, 3)))
        if views.last and 180 - directions.span <= 2 * np.median(steps):
            return views
        first, last = place < share / 2 * directions.span, place > (1 - share / 2) * directions.span
        if not 0 < (first | last).mean() < 1:
            raise ValueError(f"{len(place)} tilts are too few to leave out the outermost; give at least three")
        return cls(np.where(first, 1, np.where(last, 2, 0)))

    @classmethod
    def halves(cls, tilt_angles: NDArray[np.float64]) -> Holdout:
        """Two groups of every second view."""
        return cls(view_numbers(tilt_angles) % 2)

    @property
    def last(self) -> int:
        """The highest number."""
        return int(self.groups.max())

    @property
    def between(self) -> NDArray[np.bool_]:
        """(tilt,) whether tilts on both sides of a group predict it."""
        return np.asarray((self.groups > 0) & (self.groups < self.last))

    def tilts(self) -> list[NDArray[np.int64]]:
        """Indices of the tilts of each group that has some."""
        return [np.flatnonzero(self.groups == number) for number in np.unique(self.groups)]

    def folds(self, count: int) -> Iterator[NDArray[np.bool_]]:
        """(tilt,) the tilts of every `count`-th group, from the first groups on."""
        yield from (self.groups % count == fold for fold in range(count))
