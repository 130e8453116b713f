"""First guesses from a tilt series: detector response, scale of attenuation, slabs, and whether the contrast matches the mode."""

import warnings
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import OptimizeResult, least_squares, minimize_scalar
from torch import Tensor

from noiseflow.arrays import strided
from noiseflow.checks import SIGNIFICANT
from noiseflow.io import mapped
from noiseflow.statistics import Array, Line, weighted_line
from recon.projection.base import Projector
from recon.projection.classical import sirt
from recon.projection.image_formation import Linear, Transmission
from recon.projection.projector import SliceProjector
from recon.series.masks import binned, coarse, filled, used_values, without_spikes
from recon.series.matching import ITERATIONS
from recon.series.tilt_series import Mode, TiltSeries
from recon.series.views import AROUND, HARMLESS

LEAST_SHARE = 0.02
"""Of the incident intensity: darker values are clipped to it."""
_OWN_TILT = np.deg2rad(HARMLESS["own tilt"])


def estimate_response(tilt_series: TiltSeries, *, estimate: bool = True, level: float = 0.0) -> Transmission | Linear:
    """Initial estimate of the detector response: vacuum is brightest in bright field and darkest in HAADF.

    Args:
        estimate: whether the fit refines the response.
        level: constant level of linear images, detector units; the response is that of pixel values above it.

    Raises:
        ValueError: bright-field images have no positive values.
    """
    beam = None if tilt_series.beam is None else torch.from_numpy(tilt_series.beam.astype(np.float32))
    block = max(1, min(8, *(size // 8 for size in tilt_series.images.shape[1:])))
    means, behind = binned(tilt_series, block, block), behind_section(coarse(tilt_series))
    estimate = estimate and behind is None
    if tilt_series.mode == "linear":
        low, bright = (float(value) for value in np.quantile(used_values(means), (0.02, 0.98)))
        dark = low if behind is None else behind
        span = bright - dark if bright > dark else 1.0
        return Linear(offset=dark - level, beam=beam, offset_unit=span, estimate=estimate)
    flat = 1.0 if tilt_series.beam is None else tilt_series.beam[:, None, None]
    intensity = float(np.quantile(used_values(means, means.images / flat), 0.95)) if behind is None else behind
    if intensity <= 0:
        raise ValueError("a transmission series needs a positive vacuum; its images are negative: try --mode linear")
    return Transmission(intensity if beam is None else intensity * beam, estimate=estimate)


class _Strip:
    """Means of the images of a section over a strip as wide as the cosine, in which all images show the same part of it.

    Along the beam, a section is as thick as the inverse cosine of its tilt angle, that of the stage and its own. Linear pixel
    values, and the logarithms of those of bright field, follow it along lines, which begin with the value of vacuum.

    Args:
        tilt_series: the images; those that are black, or have no pixels in use, are left out.
    """

    def __init__(self, tilt_series: TiltSeries) -> None:
        images, used = np.asarray(tilt_series.images, dtype=np.float64), tilt_series.used
        sign, self.beam = -1 if tilt_series.mode == "linear" else 1, np.ones(len(images))
        if tilt_series.beam is not None and sign < 0:
            self.beam = tilt_series.beam / np.exp(np.log(tilt_series.beam).mean())
        elif tilt_series.beam is not None:
            images = images / tilt_series.beam[:, None, None]
        parts = (sign * image[use] for image, use in zip(images, used, strict=True))
        nearest = np.array([np.quantile(part, 0.95) if part.size else -np.inf for part in parts])
        seen = nearest > (-np.inf if sign < 0 else 0)
        images, nearest, used, self.beam = sign * images[seen], nearest[seen], used[seen], self.beam[seen]
        if sign > 0:
            images, nearest = np.log(np.maximum(images, LEAST_SHARE * nearest[:, None, None])), np.log(nearest)
        self.angles, self.nearest, self.sign = np.deg2rad(tilt_series.tilt_angles[seen]), nearest, sign
        self.sums, self.counts = (images * used).sum(1), used.sum(1)
        self.place = np.abs(np.arange(images.shape[2]) - (images.shape[2] - 1) / 2)

    @property
    def enough(self) -> bool:
        """Whether there are enough thicknesses to tell whether they lie on a line; angles of both signs show the same one."""
        return len(np.unique(np.cos(self.angles).round(6))) > AROUND // 2

    def line(self, own: float, scale: float = 1.0, level: Array | None = None) -> tuple[Line, Array, Array]:
        """The line through the means of the strip of a section tilted by its `own` angle (radians), if all angles are `scale`
        times as large, or through other levels; these, and what they are beside the line."""
        cosine = np.abs(np.cos(scale * self.angles - own)).clip(1e-3)
        half = self.place[self.counts.any(0)].max() + 0.5  # of the columns in use: those beside them may be padding
        strip = np.clip(half * cosine[:, None] / cosine.max() + 0.5 - self.place, 0, 1)
        mean = (self.sums * strip).sum(1) / np.maximum((self.counts * strip).sum(1), 1) if level is None else level
        # weights of the cosine, because a line through steep tilts would hang on them alone
        line = weighted_line(self.beam / cosine, mean, cosine**2)
        return line, mean, (mean - line.intercept - line.slope * self.beam / cosine) * cosine

    @cached_property
    def own(self) -> float:
        """The section's own tilt, radians."""
        return float(minimize_scalar(lambda own: self.line(own)[0].chi_squared, bounds=(-_OWN_TILT, _OWN_TILT)).x)


def behind_section(tilt_series: TiltSeries) -> float | None:
    """The pixel value of vacuum, if a section fills the images without vacuum; None where they do not show one.

    The values next to that of vacuum show whether there is any: it is the same in all images.
    """
    strip = _Strip(tilt_series)
    if not strip.enough:
        return None
    (found, mean, _), (end, *_) = strip.line(strip.own), strip.line(strip.own, level=strip.nearest)
    # quiet images of an object in vacuum have significant slopes, too, which are nothing beside their contrast
    chance = SIGNIFICANT * end.slope_error * end.chi_squared**0.5
    if -end.slope <= max(chance, HARMLESS["beam"] * float(np.mean(strip.nearest - mean))):
        return None
    return float(-found.intercept if strip.sign < 0 else np.exp(found.intercept))


def scale_by_section(tilt_series: TiltSeries) -> tuple[float, float]:
    """The factor on all tilt angles with which the means of the strip of a section lie on a line, and its standard error: that of
    the fit, and the jackknife's over parts of the rows, because particles differ between them."""

    def fitted(rows: NDArray[np.int64], *starts: Array) -> OptimizeResult:
        strip = _Strip(tilt_series.rows(rows))
        bounds, size = ((-_OWN_TILT, scales[0]), (_OWN_TILT, scales[-1])), np.ptp(strip.nearest)
        fits = (least_squares(lambda way: strip.line(*way)[2] / size, start, bounds=bounds) for start in starts)
        return min(fits, key=lambda fit: fit.cost)

    rows, scales = np.arange(tilt_series.images.shape[1]), np.geomspace(0.5, 2, 9)
    found = fitted(rows, *(np.array([0.0, scale]) for scale in scales[1:-1]))  # wrong scales have minima of their own
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * (found.fun @ found.fun) / max(len(found.fun) - 4, 1)
    parts = np.array_split(rows, AROUND)
    others = np.array([fitted(np.setdiff1d(rows, part), found.x).x[1] for part in parts if 0 < len(part) < len(rows)])
    spread = others.var() * (len(others) - 1) if len(others) else 0.0  # a single row has no parts
    return float(found.x[1]), float(np.sqrt(covariance[1, 1] + spread))


def beyond_sides(tilt_series: TiltSeries) -> bool:
    """Whether the specimen goes on beside the images: they show no vacuum, or much of the mean line integral at a side."""
    return at_sides(tilt_series) > HARMLESS["sides"]


def at_sides(tilt_series: TiltSeries) -> float:
    """Mean line integral of the outer columns relative to that of all columns, above the emptiest columns of a few neighbouring
    tilts, or above vacuum where a section fills the images.

    Steep tilts show vacuum beside an object that low tilts cut off: its outer columns are the emptiest in the mean of all images.
    That column counts in bright field, whose exposures may grow with the tilt; other levels are not smooth over the tilts.
    """
    used, vacuum, images = tilt_series.used, 0.0, torch.from_numpy(np.asarray(tilt_series.images, dtype=np.float32))
    lines = np.where(used, estimate_response(tilt_series).invert(images).numpy(), np.nan)
    profile = np.nanmean(lines[:, :, used.any((0, 1))], (0, 1))
    if behind_section(tilt_series) is None:
        vacuum = float(profile.min())
        if tilt_series.mode == "linear":  # most of the mean is that of matter, which fills the width
            vacuum = level if (level := _emptiest(lines[tilt_series.rising])) < 0.9 * profile.mean() else 0.0
    return max(0.0, float((profile[[0, -1]].max() - vacuum) / max(profile.mean() - vacuum, 1e-30)))


def _emptiest(lines: NDArray[np.float32]) -> float:
    """Mean of the emptiest tenth of the columns in the emptiest neighbouring tilts, of (tilt, y, u) line integrals by angle.

    Each half of the rows chooses, and the other one is measured, because the emptiest of noise is below its mean. The outer
    columns then have 0.5 to 0.8 of the mean of a truncated slab, and 0.36 at most of objects in view (twelve scenes, six noises),
    but those of a film in skewed outliers 0.48.
    """
    parts = (np.ma.masked_invalid(lines[:, first % lines.shape[1] :: 2]) for first in (0, 1))
    halves, found = np.stack([part.mean(1).filled(np.nan) for part in parts]), list[float]()
    halves[:, np.isnan(halves).any(0)] = np.nan  # columns that not both show
    halves = halves[:, np.isfinite(halves[0]).any(1)]
    for chosen, measured in (halves, halves[::-1]) if halves.size else ():
        few = chosen <= np.nanquantile(chosen, 0.1, axis=1, keepdims=True)
        levels = np.nanmean(np.where(few, (chosen, measured), np.nan), 2)
        least, level = median_filter(levels, (1, min(AROUND, max(1, len(chosen) // 2))), mode="nearest")
        found.append(level[np.argmin(least)])
    return float(np.mean(found or 0.0))


FEW_ITERATIONS = 30  # of a rough volume
SIDES = 3  # widths of the images that `widened` ones have


def widened(tilt_series: TiltSeries) -> TiltSeries:
    """The series in float32, with masked columns at both sides: in a narrow volume, a tilted section looks thinner."""
    sides = ((0, 0), (0, 0), ((SIDES - 1) * tilt_series.images.shape[2] // 2,) * 2)
    images = np.pad(np.asarray(tilt_series.images, dtype=np.float32), sides, mode="edge")
    return tilt_series.with_images(images, np.pad(tilt_series.used, sides))


def rough_volume(tilt_series: TiltSeries, response: Transmission | Linear, projector: Projector) -> Tensor:
    """A few iterations of SIRT on bands of four slices, (z, y/4, x); of single slices, if they are not independent."""
    bands = binned(tilt_series, 1 if projector.fixed_height else min(4, tilt_series.images.shape[1]), 1)
    images = torch.from_numpy(bands.images).to(projector.device)
    used = None if bands.mask is None else torch.from_numpy(bands.mask).to(images)
    with torch.no_grad():
        return sirt(response.invert(images).contiguous(), projector, num_iterations=FEW_ITERATIONS, used=used)


def attenuation_scale(volume: Tensor) -> float:
    """Typical attenuation per voxel outside vacuum: the mean weighted by the squared attenuation."""
    power = (volume**2).sum()
    return float((volume**3).sum() / power) if power > 0 else 1.0


def contrast_slab(tilt_series: TiltSeries, num_slices: int) -> slice:
    """The `num_slices` neighbouring slices with the largest variation of the images; all of a series about two axes."""
    height = tilt_series.images.shape[1]
    if num_slices >= height or tilt_series.axes is not None:
        return slice(0, height)
    start = int(_variation(tilt_series, num_slices).argmax())
    return slice(start, start + num_slices)


def calm_slab(tilt_series: TiltSeries, num_slices: int, apart_from: slice) -> slice:
    """At most `num_slices` neighbouring slices with the smallest variation of the images, outside `apart_from`."""
    num_slices = min(num_slices, max(apart_from.start, tilt_series.images.shape[1] - apart_from.stop))
    if num_slices == 0:
        return slice(0, 0)
    variation = _variation(tilt_series, num_slices)
    variation[max(0, apart_from.start - num_slices + 1) : apart_from.stop] = np.inf
    start = int(variation.argmin())
    return slice(start, start + num_slices)


def _variation(tilt_series: TiltSeries, num_slices: int) -> NDArray[np.float64]:
    """Variation of the mean image in every range of `num_slices` neighbouring slices, by its first slice."""
    if tilt_series.mask is None:
        mean = tilt_series.images.mean(0, dtype=np.float32)
    else:
        pairs = zip(tilt_series.images, tilt_series.mask, strict=True)
        total = sum((np.where(use, image, 0).astype(np.float32) for image, use in pairs), np.float32(0))
        count = tilt_series.mask.sum(0)
        mean = filled(total / np.maximum(count, 1), count > 0)
    return np.convolve(mean.var(1), np.ones(num_slices), mode="valid")


def invert_contrast(tilt_series: TiltSeries) -> TiltSeries:
    """Invert the contrast: every pixel value becomes largest + smallest − value of those used, in the same data type."""
    images, mask = tilt_series.images, tilt_series.mask
    largest, smallest = (each(images if mask is None else images[mask]) for each in (np.max, np.min))
    # this order avoids integer overflow
    swapped = ((largest - image) + smallest for image in images)
    return replace(tilt_series, images=mapped.mapped_copy(swapped, images.shape, images.dtype))


def check_contrast(tilt_series: TiltSeries) -> None:
    """Warn if a coarse non-negative volume explains the images better with inverted contrast."""
    as_given, swapped = explained_both(tilt_series)
    if swapped > as_given + HARMLESS["contrast"]:
        given, other = ("bright field", "--mode linear if these are HAADF or EDX images")
        if tilt_series.mode == "linear":
            given, other = ("HAADF or EDX", "--mode transmission if these are bright-field images")
        warnings.warn(
            f"the contrast looks inverted for {given}: a coarse volume explains {max(as_given, 0):.0%} of the images, and "
            f"{swapped:.0%} with inverted contrast; give {other}, otherwise --invert-contrast",
            stacklevel=2,
        )


def likely_mode(tilt_series: TiltSeries) -> Mode | None:
    """``linear`` if a coarse non-negative volume on a dark background explains the images better than their inverse,
    ``transmission`` if it is the other way round; if they are explained alike, the median of the values decides, or nothing
    (None).

    Both shares are those of the linear model, whose volume follows noise alike in both. Exposures may differ between images:
    means count only for sections, which become thicker when they are tilted. Counts that are zero in most pixels have a dark
    background.
    """
    images, used = strided(tilt_series.images), strided(tilt_series.used)
    values = images[used]
    if (values == values.min()).mean() > 0.5:
        return "linear"
    small = coarse(without_spikes(tilt_series))
    means = small.images.mean((1, 2), keepdims=True, where=small.used)
    for level in (means, 0):
        dark, bright = explained_both(replace(small, images=small.images - level, mode="linear", beam=None))
        found: Mode = "linear" if dark > bright else "transmission"
        with suppress(ValueError):  # images that are negative are no bright field
            if abs(dark - bright) > HARMLESS["contrast"] and not (
                level is means and beyond_sides(replace(small, mode=found))
            ):
                return found
    low, usual, high = np.quantile(values, (0.005, 0.5, 0.995))
    place, background = (usual - low) / max(high - low, 1e-30), HARMLESS["background"]
    return "linear" if place < background else "transmission" if place > 1 - background else None


def explained_both(tilt_series: TiltSeries) -> tuple[float, float]:
    """Shares of the variance that coarse volumes explain, as given and with inverted contrast."""
    series = coarse(without_spikes(tilt_series))
    return explained(series), explained(invert_contrast(series))


def explained(tilt_series: TiltSeries) -> float:
    """Share of the variance of the images that a non-negative volume explains after a few iterations of SIRT."""
    try:
        response = estimate_response(tilt_series)
    except ValueError:  # no positive incident intensity, so there is no such volume
        return 0.0
    depth, wide = tilt_series.images.shape[2], widened(tilt_series)
    images, used = torch.from_numpy(wide.images), torch.from_numpy(wide.used).float()
    projector = SliceProjector(tilt_angles=wide.tilt_angles, depth=depth, width=images.shape[2])
    with torch.no_grad():
        volume = sirt(response.invert(images).contiguous(), projector, num_iterations=3 * ITERATIONS, used=used)
        predicted = response(projector(volume).transpose(1, 2)).transpose(1, 2)
    mean = (images * used).sum() / used.sum()
    return 1 - float(((predicted - images).square() * used).sum() / ((images - mean).square() * used).sum())
