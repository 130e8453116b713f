"""Other geometries: angles or two objects that predict held-out gaps of tilts better."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Effect
from recon.series.holdout import GAP
from recon.verdict.compared import Coarse, neighbours
from recon.verdict.gap_fit import GapFit
from recon.verdict.tilts import smoothest_order

Array = NDArray[Any]
_SMOOTHNESS = (0.03, 0.3, 1.0)
REPLICATES = 8
"""Series drawn from the fit; the standard error of their standard deviation is a quarter."""
# share of the degrees of freedom, if a fit has nearly as many parameters as data
_LEAST_FREE = 0.1


class Geometry:
    """Prediction of held-out gaps of a coarse series by the given geometry and by others.

    Attributes:
        coarse: the series.
        fit: fit with the given geometry, at the smoothness that predicts gaps best.
        errors: (tilt, y, u) prediction errors of that fit.
        left: (tilt, y, u) residuals of that fit to all tilts.
    """

    def __init__(self, coarse: Coarse) -> None:
        self.coarse = coarse
        least = np.inf
        for smoothness in _SMOOTHNESS:
            fit = self._fit(smoothness)
            errors = self._errors(fit)
            if (size := float(np.mean(errors**2))) < least:
                least, self.smoothness, self.fit, self.errors = size, smoothness, fit, errors
            del fit, errors  # a fit is larger than the images
        flat = coarse.centred_on_all
        self.left = (flat - self.fit.fitted(flat)) * coarse.used

    @cached_property
    def single(self) -> GapFit:
        """The fit that holds out single angles, which their neighbours predict."""
        return self._fit(self.smoothness, gap=self._step)

    @property
    def smooth_single(self) -> GapFit:
        """The same, smooth so that noise hides no odd tilt."""
        return self.single if self.smoothness == _SMOOTHNESS[1] else self._fit(_SMOOTHNESS[1], gap=self._step)

    @property
    def _step(self) -> float:
        """Degrees from one angle to the next."""
        directions = self.coarse.directions
        return directions.span / len(np.unique(np.round(directions.angles, 3)))

    @cached_property
    def replicates(self) -> Array:
        """(replicate, tilt, y, u) series of the given geometry: the fit with its residuals in random signs, the same along rows,
        in which most detectors correlate their noise.

        Residuals are smaller than the noise by the degrees of freedom of the fit.
        """
        count, height, width = self.left.shape
        free = 1 - float((self.fit.half**2).sum()) / (count * width)
        noise = self.left / np.sqrt(max(free, _LEAST_FREE))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(REPLICATES, count, height, 1))
        signs[:, self.coarse.directions.order] = signs.copy()  # so that the order of the tilts changes nothing
        fitted = self.fit.fitted(self.coarse.centred_on_all)
        # single precision and one at a time: blocks of tall series leave little memory
        return np.stack([((fitted + sign * noise) * self.coarse.used).astype(np.float32) for sign in signs])

    @cached_property
    def fitted_replicates(self) -> list[Array]:
        """The projections of a volume of each."""
        return [self.fit.fitted(images).astype(np.float32) for images in self.replicates]

    def _errors(self, fit: GapFit) -> Array:
        return fit.errors(self.coarse.images, self.coarse.used)

    def _fit(self, smoothness: float, *, gap: float = GAP, **changes: Any) -> GapFit:
        coarse = replace(self.coarse, **changes)
        return GapFit(
            coarse.tilt_angles,
            depth=coarse.depth,
            width=coarse.width,
            detector_width=coarse.images.shape[2],
            detector_offset=coarse.detector_offset,
            smoothness=smoothness,
            gap=gap,
        )

    @property
    def structure(self) -> float:
        """Structure common to neighbouring pixels, in standard errors: the larger value of y and u."""
        flat = self.coarse.centred(self.coarse.images)
        chance = max(float(np.mean(flat**2)) / float(np.sqrt(flat.size)), 1e-30)
        return max(neighbours(flat, axis) for axis in (1, 2)) / chance

    @property
    def edge(self) -> float:
        """Mean line integral of the outer columns relative to that of all columns, both above the emptiest column."""
        used = self.coarse.used.sum((0, 1))
        profile = ((self.coarse.images * self.coarse.used).sum((0, 1)) / np.maximum(used, 1))[used > 0]
        raised = profile - profile.min()
        return float(max(raised[0], raised[-1]) / max(raised.mean(), 1e-30))

    def transposed(self) -> Effect:
        """Images with rows and columns exchanged, as if the tilt axis were across."""
        if self.coarse.images.shape[1] != self.coarse.images.shape[2]:
            return Effect(0.0)
        errors = self.fit.errors(self.coarse.images.transpose(0, 2, 1), self.coarse.used.transpose(0, 2, 1))
        return positive(self._gain(errors, self.errors, ""))

    def rescaled(self, factor: float) -> Effect:
        """All tilt angles times a factor."""
        fit = self._fit(self.smoothness, tilt_angles=self.coarse.tilt_angles * factor)
        return self._beyond_expected(self._errors(fit), fit.errors(self.replicates[0], self.coarse.used), "")

    def reordered(self) -> Effect:
        """The images in the order in which they change least, at the same angles."""
        errors, expected = (self._reordered(each) for each in (self.coarse.images, self.replicates[0]))
        return positive(self._beyond_expected(errors, expected, ""))

    def _reordered(self, images: Array) -> Array:
        """Errors of images, given in rising order of the angles."""
        order = self.coarse.directions.order
        moved, used = np.empty_like(images), np.empty_like(self.coarse.used)
        given = order[smoothest_order(self.coarse.directions.arranged(self.coarse.centred(images)))]
        moved[order], used[order] = images[given], self.coarse.used[given]
        return self.fit.errors(moved, used)

    def two_objects(self) -> Effect:
        """Separate volumes for parts of the series: halves, and every other tilt."""
        order = self.coarse.directions.order
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        parts = {"halves": rank < len(order) // 2, "every other tilt": rank % 2 == 0}
        return positive(max(self._apart(first, name) for name, first in parts.items()))

    def _apart(self, first: Array, name: str) -> Effect:
        errors, expected = np.empty_like(self.errors), np.empty_like(self.errors)
        for part in (first, ~first):
            fit, used = self._fit(self.smoothness, tilt_angles=self.coarse.tilt_angles[part]), self.coarse.used[part]
            errors[part] = fit.errors(self.coarse.images[part], used)
            expected[part] = fit.errors(self.replicates[0][part], used)
        return self._beyond_expected(errors, expected, name)

    def _beyond_expected(self, errors: Array, expected: Array, what: str) -> Effect:
        """The gain of another geometry beyond that which it has for a series of the given one: smaller angles and fewer rays make
        any volume smoother, which predicts some objects better."""
        gain = self._gain(errors, self.errors, what)
        chance = self._gain(expected, self.fit.errors(self.replicates[0], self.coarse.used), what)
        return gain._replace(value=gain.value - max(0.0, chance.value))

    def _gain(self, errors: Array, as_given: Array, what: str) -> Effect:
        """Reduction of the errors relative to the given geometry; its standard error is that of the mean over the gaps."""
        per_tilt = (as_given**2 - errors**2).mean((1, 2))
        per_gap = np.array([per_tilt[tilts].mean() for tilts in self.fit.gaps])
        whole = max(float(np.mean(self.errors**2)), 1e-30)
        error = float(per_gap.std(ddof=1) / np.sqrt(len(per_gap))) / whole
        return Effect(float(per_tilt.mean()) / whole, error, what)


def positive(effect: Effect) -> Effect:
    """The effect if it is positive, otherwise none."""
    return effect._replace(value=max(0.0, effect.value))
