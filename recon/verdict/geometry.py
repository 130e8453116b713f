"""Tests of alternative geometries: another tilt axis, other angles, a thicker volume, two objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.verdict.coarse import Coarse
from recon.verdict.gap_fit import GAP, GapFit

Array = NDArray[Any]
_SMOOTHNESS = (0.03, 0.3, 1.0)
_SINGLE = 0.3  # smoothness for single held-out tilts; with less, noise would hide inconsistent tilts
_TURNS = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0)  # degrees, in both directions
_SMALL = (
    20.0  # degrees: smaller rotations are compared with their opposite, because both have the same interpolation error
)
_LIKE_A_TURN = 0.211  # pixels: interpolation at this shift reduces noise like a rotation: f² + (1 − f)² = 2/3
_SCALES = (0.6, 0.75, 0.9, 1.1, 1.3)
# degrees: a larger range than a half turn is stated by few stages, and would be tried in vain
_WIDEST = 190.0


@dataclass(frozen=True)
class Gain:
    """Improvement of the prediction of held-out tilts by another geometry.

    Attributes:
        share: improvement relative to the error of the given geometry.
        score: improvement in standard errors over the gaps.
        what: description of the geometry.
    """

    share: float
    score: float
    what: str


class Geometry:
    """Prediction of held-out gaps of a coarse series by the given geometry and by others.

    Attributes:
        coarse: the series.
        fit: fit with the given geometry, at the smoothness that predicts gaps best.
        errors: (tilt, y, u) prediction errors of that fit.
    """

    def __init__(self, coarse: Coarse) -> None:
        self.coarse = coarse
        self.smoothness = min(_SMOOTHNESS, key=lambda each: float(np.mean(self._fit(each).errors(coarse.images) ** 2)))
        self.fit = self._fit(self.smoothness)
        self.errors = self.fit.errors(coarse.images)

    def single_errors(self) -> Array:
        """(tilt, y, u) errors of the smoothest fit when single angles are held out and predicted by their neighbours."""
        angles = self.coarse.tilt_angles
        each = float(np.ptp(angles)) / len(np.unique(np.round(angles, 3)))
        return self._fit(_SINGLE, gap=each).errors(self.coarse.images)

    def _fit(self, smoothness: float, *, offset: float = 0.0, gap: float = GAP, **changes: Any) -> GapFit:
        coarse = replace(self.coarse, **changes)
        return GapFit(
            coarse.tilt_angles,
            depth=coarse.depth,
            width=coarse.width,
            detector_width=coarse.images.shape[2],
            detector_offset=coarse.detector_offset + offset,
            smoothness=smoothness,
            gap=gap,
        )

    def axis(self) -> Gain:
        """The best other direction of the tilt axis."""
        images = self.coarse.images
        moved = np.stack([ndimage.shift(i, (_LIKE_A_TURN,) * 2, order=1, mode="nearest") for i in images])
        as_given = self._fit(self.smoothness, offset=_LIKE_A_TURN).errors(moved)
        gains = []
        for size in _TURNS:
            both = {turn: self.fit.errors(_turned(images, turn)) for turn in (-size, size)}
            for turn, errors in both.items():
                gain = self._gain(errors, as_given, f"turned by {turn:g}°")
                mirrored = self._gain(errors, both[-turn], f"turned by {turn:g}°")
                gains.append(gain if size > _SMALL else _smaller(gain, mirrored))
        if images.shape[1] == images.shape[2]:
            gains.append(self._gain(self.fit.errors(images.transpose(0, 2, 1)), self.errors, "turned by 90°"))
        return max(gains, key=lambda gain: gain.share)

    def angles(self) -> Gain:
        """The best other scale of the tilt angles."""
        span = float(np.ptp(self.coarse.tilt_angles))
        scales = [scale for scale in _SCALES if scale < 1 or scale * span <= _WIDEST]
        return max(
            (self._with(f"multiplied by {scale:g}", tilt_angles=self.coarse.tilt_angles * scale) for scale in scales),
            key=_share,
        )

    def thicker(self) -> Gain:
        """A volume with a depth equal to the width, if it is thinner."""
        return self._with("as deep as wide", depth=max(self.coarse.depth, self.coarse.width))

    def two_objects(self) -> Gain:
        """Separate volumes for parts of the series: halves, and every other tilt."""
        order = self.coarse.order
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        parts = {"halves": rank < len(order) // 2, "every other tilt": rank % 2 == 0}
        return max((self._apart(first, name) for name, first in parts.items()), key=_share)

    def _apart(self, first: Array, name: str) -> Gain:
        errors = np.empty_like(self.errors)
        for part in (first, ~first):
            images, angles = self.coarse.images[part], self.coarse.tilt_angles[part]
            errors[part] = self._fit(self.smoothness, tilt_angles=angles, images=images).errors(images)
        return self._gain(errors, self.errors, name)

    def _with(self, what: str, **changes: Any) -> Gain:
        return self._gain(self._fit(self.smoothness, **changes).errors(self.coarse.images), self.errors, what)

    def _gain(self, errors: Array, as_given: Array, what: str) -> Gain:
        """Reduction of the errors relative to the given geometry; its standard error is that of the mean over the gaps."""
        per_tilt = (as_given**2 - errors**2).mean((1, 2))
        per_gap = np.array([per_tilt[tilts].mean() for tilts in self.fit.gaps])
        whole = max(float(np.mean(self.errors**2)), 1e-30)
        error = per_gap.std(ddof=1) / np.sqrt(len(per_gap))
        return Gain(float(per_tilt.mean()) / whole, float(per_gap.mean() / max(error, 1e-30)), what)


def _share(gain: Gain) -> float:
    return gain.share


def _smaller(*gains: Gain) -> Gain:
    return min(gains, key=_share)


def _turned(images: Array, degrees: float) -> Array:
    turned = [ndimage.rotate(image, degrees, reshape=False, order=1, mode="nearest") for image in images]
    return np.stack(turned)
