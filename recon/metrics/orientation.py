"""Whether two volumes would fit much better after a flip or with their axes in another order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

_EDGE = 48  # voxels along an edge: coarse shapes show the orientation, and 48 orientations take no time
_MORE = 0.1  # share of the variance: more than noise and nearly symmetric specimens make


@dataclass(frozen=True)
class OtherOrientation:
    """An orientation of a volume that fits a reference much better than the given one.

    Attributes:
        axes: axes of the volume in the order that fits the reference's (z, y, x), such as ``yzx``.
        flipped: axes of the reference along which the volume must then be mirrored.
        correlation: correlation of coarse voxels in this orientation.
        given: the same as given; None if the shapes differ.
    """

    axes: str
    flipped: str
    correlation: float
    given: float | None

    def in_words(self) -> str:
        """One line."""
        order = f"with its axes in the order ({', '.join(self.axes)})" if self.axes != "zyx" else ""
        flips = f"mirrored along {' and '.join(self.flipped)}" if self.flipped else ""
        given = "" if self.given is None else f", {self.given:.2f} as given"
        what = " and ".join(filter(None, (order, flips)))
        return f"the volume {what} would fit much better: correlation {self.correlation:.2f}{given}"


def better_orientation(volume: NDArray[Any], reference: NDArray[Any]) -> OtherOrientation | None:
    """The best of the 48 axis orders and flips if it fits much better than the given one, or if only it has the same shape.

    Args:
        volume: (z, y, x).
        reference: (z, y, x).
    """
    factor = max(1, -(-max(*volume.shape, *reference.shape) // _EDGE))
    first, second = _coarse(volume, factor), _coarse(reference, factor)
    found: dict[tuple[str, str], float] = {}
    for order in permutations(range(3)):
        if tuple(volume.shape[axis] for axis in order) != reference.shape:
            continue
        for flips in product((False, True), repeat=3):
            axes = tuple(axis for axis, flip in enumerate(flips) if flip)
            turned = np.flip(first.transpose(order), axes)
            name = "".join("zyx"[axis] for axis in order), "".join("zyx"[axis] for axis in axes)
            found[name] = float(np.mean(turned * second))
    given = found.get(("zyx", ""))
    if not found:
        return None
    best = max(found, key=lambda name: found[name])
    if given is not None and found[best] ** 2 < max(given, 0.0) ** 2 + _MORE:
        return None
    return OtherOrientation(*best, found[best], given)


def _coarse(volume: NDArray[Any], factor: int) -> NDArray[np.float64]:
    """Block means around the centre, of mean 0 and standard deviation 1."""
    edges = [min(factor, size) for size in volume.shape]
    counts = [size // edge for size, edge in zip(volume.shape, edges, strict=True)]
    parts = [
        slice((size % edge) // 2, size - (size % edge + 1) // 2) for size, edge in zip(volume.shape, edges, strict=True)
    ]
    middle, means = volume[tuple(parts)], np.zeros(counts)
    for row in range(counts[0]):
        slab = np.asarray(middle[row * edges[0] : (row + 1) * edges[0]], dtype=np.float64)
        means[row] = slab.reshape(edges[0], counts[1], edges[1], counts[2], edges[2]).mean((0, 2, 4))
    spread = float(means.std())
    return np.asarray((means - means.mean()) / (spread or 1.0))
