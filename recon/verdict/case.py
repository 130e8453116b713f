"""A reconstruction to assess, with what several checks need: residuals, distortions, and predictions of held-out tilts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Effect, NotTested
from recon.series.alignment import Alignment
from recon.series.contrast import explained, invert_contrast
from recon.series.first_guess import contrast_slab
from recon.series.masks import coarse
from recon.series.screening import Screening
from recon.series.shrinkage import FEWEST_TILTS, estimate_shrinkage
from recon.series.tilt_series import TiltSeries, VolumeGrid, evenly
from recon.verdict.coarse import Coarse, coarse_series, line_integrals
from recon.verdict.distortions import Distortion, distortions
from recon.verdict.expected import Result, expected_images
from recon.verdict.gap_fit import Unexplained, unexplained
from recon.verdict.geometry import Geometry
from recon.verdict.residuals import Residuals
from recon.verdict.sharpness import sharp_integrals
from recon.verdict.tilts import largest_gaps

Array = NDArray[Any]
# widths: only this number of slices of a taller series is used, because all may not fit into memory
_TALL = 4
# directions: fewer leave too few gaps for a standard error, and are too few for fine detail
FEWEST = 20
# standard errors of the structure common to neighbouring pixels: with less, no object is visible
_VISIBLE = 8.0

# of the size: polymers lose up to a fifth under the beam
_MOST_CHANGE = 0.25


@dataclass(frozen=True)
class Case:
    """A reconstruction to assess; what several checks need is computed once, by the first that needs it.

    Attributes:
        tilt_series: the reconstructed series.
        result: volume and projections (tilt, y, u), detector units.
        screening: screening of all tilts, if done.
        alignment: alignment of the raw images, if done.
    """

    tilt_series: TiltSeries
    result: Result
    screening: Screening | None = None
    alignment: Alignment | None = None

    @cached_property
    def rows(self) -> slice:
        """The slices that are used."""
        return contrast_slab(self.tilt_series, _TALL * self.tilt_series.images.shape[2])

    @cached_property
    def series(self) -> TiltSeries:
        """The series in these slices."""
        return self.tilt_series.rows(self.rows)

    @cached_property
    def expected(self) -> Array:
        """(tilt, y, u) expected images of the volume in these slices, detector units."""
        return expected_images(self.result, self.rows)

    @cached_property
    def residuals(self) -> Residuals:
        """Images minus their expectation."""
        return Residuals.of(self.series, self.expected)

    @cached_property
    def distortions(self) -> dict[str, Distortion]:
        """Distortions of the images relative to the volume."""
        return distortions(self.residuals)

    @property
    def edge(self) -> float:
        """Pixels from the centre of the images to their edge."""
        return float(self.residuals.images.shape[2]) / 2

    @cached_property
    def integrals(self) -> Array:
        """(tilt, y, u) line integrals of the slices with the highest contrast, sorted by angle."""
        return sharp_integrals(self.series, self.residuals)

    @property
    def predicted_integrals(self) -> Array:
        """(tilt, y, u) line integrals of the projections of the volume, in the same slices and order."""
        return sharp_integrals(self.series, self.residuals, self.residuals.projections)

    @cached_property
    def coarse(self) -> Coarse:
        """Coarse line integrals."""
        depth, _, width = np.shape(self.result.volume.attenuation)
        return coarse_series(self.series, VolumeGrid(depth, self.rows.stop - self.rows.start, width))

    @cached_property
    def geometry(self) -> Geometry:
        """Predictions of held-out gaps of tilts."""
        own, used = self.own
        residual = (self.coarse.images - own) * used
        sign = np.random.default_rng(0).choice([-1.0, 1.0], size=(*own.shape[:2], 1))
        return Geometry(self.coarse, own + sign * residual)

    @cached_property
    def own(self) -> tuple[Array, Array]:
        """(tilt, y, u) coarse line integrals of the volume's own projections, and the pixels in use."""
        expected = self.expected[evenly(self.coarse.tilts, len(self.expected))]
        return line_integrals(self.series.select(self.coarse.tilts), expected, self.coarse.binning)

    @property
    def other_geometries(self) -> Geometry:
        """The same, where other geometries can be compared. Raises `NotTested` otherwise."""
        if largest_gaps(self.coarse.tilt_angles)[2] < FEWEST:
            raise NotTested(f"needs {FEWEST} directions")
        if self.geometry.structure < _VISIBLE:
            raise NotTested("no object is visible")
        return self.geometry

    @cached_property
    def gap(self) -> Unexplained:
        """Unexplained structure of held-out gaps."""
        return unexplained(self.coarse.centred_on_all, self.geometry.errors)

    @cached_property
    def own_gap(self) -> Unexplained:
        """The same for the projections of the volume, which are consistent with each other."""
        own, used = self.own
        return unexplained((own - own[used].mean()) * used, self.geometry.fit.errors(own, used))


def inconsistent(case: Case) -> Effect:
    """Unexplained share of the structure of held-out gaps, less that which noise may leave."""
    return Effect(case.gap.share - 2 * case.gap.error)


def tolerable(case: Case) -> float:
    """The same for a correct volume: three times that of its own projections, and a share for what it cannot represent."""
    return 3 * max(case.own_gap.share, 0.0) + 0.06


def invisible(case: Case) -> Effect:
    """Required over found structure of the images, many times over if there is none."""
    return Effect(10.0 if case.geometry.structure < _VISIBLE else 0.0)


def beyond_the_sides(case: Case) -> Effect:
    """Signal at the sides relative to the mean, if held-out gaps are not explained well either."""
    unexplained_too = inconsistent(case).value > 0.5 * tolerable(case)
    return Effect(case.other_geometries.edge if unexplained_too else 0.0)


def inverted(case: Case) -> Effect:
    """Share of the images that a coarse non-negative volume explains with inverted contrast, minus that as given."""
    small = coarse(case.series, height=16, width=32)
    as_given, swapped = explained(small), explained(invert_contrast(small))
    other = "--mode transmission" if case.series.mode == "linear" else "--mode linear"
    return Effect(
        max(0.0, swapped - as_given), what=f"{max(as_given, 0):.0%} of the images, and {swapped:.0%}, give {other}"
    )


def cut_off(case: Case) -> Effect:
    """Density of the top or bottom layer relative to the mean: material beyond a thin volume is projected into them."""
    volume = case.result.volume.attenuation
    depth, height, width = volume.shape
    if depth >= width:
        return Effect(0.0)
    layers = np.abs(volume[:, :: max(1, height // 64)]).mean((1, 2), dtype=np.float64)
    return Effect(float(max(layers[0], layers[-1]) / max(float(layers.mean()), 1e-30)))


def changing_size(case: Case) -> Effect:
    """Change of the size of the specimen over the series, in the order of the dose; see `recon.series.shrinkage`."""
    if case.tilt_series.num_tilts < FEWEST_TILTS:
        raise NotTested(f"needs {FEWEST_TILTS} tilts")
    found = estimate_shrinkage(case.series)
    if abs(found.change) > _MOST_CHANGE:
        raise NotTested("the profile along the axis changes by more than any change of size")
    return Effect(found.change if found.found else 0.0, found.error, found.order)


def too_smooth(case: Case) -> Effect:
    """Coefficient of the fine structure that the projections lack, if noise is no reason to smooth it."""
    if case.residuals.noise > case.residuals.contrast:
        raise NotTested("the noise is stronger than the contrast")
    return case.distortions["sharpness"].offset


def left_in_residuals(case: Case) -> Effect:
    """Share of the structure of the images that is left in the residuals."""
    return Effect(*case.residuals.unexplained())


def tolerable_residual(case: Case) -> float:
    """The same beyond chance, and beyond the contrast that a regulariser takes where noise is stronger than the contrast."""
    noisy = case.residuals.noise > case.residuals.contrast
    missing = max(0.0, case.residuals.missing) if noisy else 0.0
    # three standard errors: noisy correct series of 24³ leave 0.069 ± 0.005
    return 0.06 + 3 * left_in_residuals(case).error + (missing / (1 + missing)) ** 2


def excluded(case: Case) -> Effect:
    """Share of tilts that screening excluded."""
    if case.screening is None:
        raise NotTested("the tilts were not screened")
    return Effect(float(case.screening.bad.mean()))


def beam_drift(case: Case) -> Effect:
    """Relative deviation of the beam over the tilts."""
    if case.screening is None:
        raise NotTested("the tilts were not screened")
    return Effect(case.screening.drift)


def at_edge(pixels: float) -> Any:
    """A tolerance for smooth shifts, rotations and magnifications: pixels in images of up to 48 pixels.

    It is proportional to the width of larger images, because tilts sample their edge more coarsely, up to the limit of visible
    blur.
    """
    return lambda case: max(pixels, min(0.5, pixels * case.edge / 24))
