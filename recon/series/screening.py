"""Screening of tilts before a reconstruction: beam drift, and tilts that are inconsistent with the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from torch import Tensor

from noiseflow.checks import LIKELY
from noiseflow.described import described
from noiseflow.statistics import neighbour_products, robust_deviation
from recon.projection.classical import sirt
from recon.projection.projector import SliceProjector
from recon.series.first_guess import SIDES, behind_section, beyond_sides, estimate_response, likely_mode, widened
from recon.series.masks import coarse, used_values, without_spikes
from recon.series.matching import ITERATIONS, ROUNDS
from recon.series.tilt_series import Mode, TiltSeries
from recon.series.views import AROUND, HARMLESS, TILE, Directions, without_level

_WIDTH = 48  # with 32, the apparent drift of a constant beam reaches 0.041
_DEVIATIONS = 6.0  # typical ones of the others


@described()
@dataclass(frozen=True)
class Screening:
    """Comparison of every tilt with a coarse reconstruction.

    Attributes:
        beam: (tilts,) incident intensity relative to the median; 1 where its drift is one by chance.
        excess: (tilts,) negative log-likelihood of the coarse image minus that of its neighbours in angle, nats per pixel.
        bad: (tilts,) True for tilts that fit the volume far worse than their neighbours.
        suspect: (tilts,) the same if they are so many that alignment or angles are in doubt; no tilt is bad in this case.
    """

    beam: NDArray[np.float64]
    excess: NDArray[np.float64]
    bad: NDArray[np.bool_]
    suspect: NDArray[np.bool_]

    @classmethod
    def of_all(cls, count: int) -> Screening:
        """All of `count` tilts are good."""
        none = np.zeros(count, dtype=np.bool_)
        return cls(np.ones(count), np.zeros(count), none, none)

    @property
    def drift(self) -> float:
        """Relative standard deviation of the beam over the good tilts."""
        return float(np.std(np.log(self.beam[~self.bad])))

    @property
    def beam_drifts(self) -> bool:
        """Whether the drift is significant, given the accuracy of a coarse volume."""
        return bool((self.beam != 1).any())

    @property
    def odd(self) -> NDArray[np.bool_]:
        """(tilts,) True for bad tilts, and for those whose beam is unlike that of the others."""
        change = np.abs(np.log(self.beam))
        return self.bad | (change > max(_DEVIATIONS * robust_deviation(change, 0.0), HARMLESS["beam"]))

    def of(self, order: Sequence[int]) -> Screening:
        """The screening of some of the tilts, by index."""
        return Screening(*(getattr(self, field.name)[list(order)] for field in fields(self)))

    def passed(self, tilt_series: TiltSeries, *, keep: bool = False) -> TiltSeries:
        """The good tilts, or all if `keep`, with their beam if it drifts."""
        series = replace(tilt_series, beam=self.beam) if self.beam_drifts else tilt_series
        return series.select(~self.bad) if self.bad.any() and not keep else series

    def choices(self) -> dict[str, float | str]:
        """Values for a table of results."""
        found: dict[str, float | str] = {}
        if self.bad.any():
            found["tilts left out"] = str(int(self.bad.sum()))
        if self.beam_drifts:
            found["beam drift"] = f"{self.drift:.1%}"
        return found

    def as_dict(self) -> dict[str, list[Any]]:
        """All results per tilt, JSON-serialisable."""
        names = "beam", "excess_nll", "bad", "suspect"
        return {name: getattr(self, field.name).tolist() for name, field in zip(names, fields(self), strict=True)}


def screen(tilt_series: TiltSeries, *, of_worst: float = 0.7) -> Screening:
    """Compare every tilt with a coarse volume of the others; if there are few tilts, all are good.

    SIRT iterations alternate with fits of the intensity of each tilt. The tilts whose residual likelihood deviates most from that
    of their neighbours, by more than the share `of_worst` of the worst, are removed, and this is repeated until none deviates.
    The volume includes the tilts that it is compared with: volumes without them find the same tilts (see the architecture page).
    """
    count = tilt_series.num_tilts
    if count < AROUND:
        return Screening.of_all(count)
    bad = none = np.zeros(count, dtype=np.bool_)
    small = replace(coarse(without_level(without_spikes(tilt_series))[0], _WIDTH), beam=None)
    section = beyond_sides(small)
    small, directions = widened(small) if section else small, Directions.of(tilt_series.tilt_angles)
    blank, dark = _blank(small, directions.order), none
    while bad.sum() <= count // 4:  # more are too many to continue
        beam, residual, predicted = _fit_beam(small, bad, section)
        nll = _negative_log_likelihood(residual, predicted, small.used, ~bad)
        good = directions.order[~bad[directions.order]]
        usual = median_filter(nll[good], size=min(AROUND, len(good)), mode="nearest")  # of neighbours in direction
        excess = nll - np.interp(directions.angles, directions.angles[good], usual)
        dark, worst = blank & (beam < 0.5), float(excess[~bad].max())
        new = dark & ~bad  # the volume follows those at the ends of the series
        if not new.any():
            if worst <= max(_DEVIATIONS * robust_deviation(excess[~bad], 0.0), HARMLESS["excess"]):
                break
            new = excess > of_worst * worst
        bad = bad | new
    many = (bad & ~dark).sum() > max(1, count * HARMLESS["inconsistent"])
    found = Screening(beam, excess, dark if many else bad, bad & ~dark if many else none)
    sizes, bright = _drifts(found, directions), small.mode == "transmission"
    steady = np.array([HARMLESS["beam"], HARMLESS["beam on vacuum" if bright else "beam"]])
    usual = (sizes > steady).any() and (found.odd == found.bad).all()  # one bright frame is no chance
    chance = _drift_by_chance(small, found, section, residual, predicted) if usual else np.zeros(2)
    return found if (sizes > np.hypot(chance, steady)).any() else replace(found, beam=np.ones(count))


def mode_of_good_tilts(tilt_series: TiltSeries) -> Mode | None:
    """`likely_mode` without tilts that are odd in both modes: inconsistent, as a black frame, or of another beam."""
    small = coarse(without_spikes(tilt_series), _WIDTH)
    odd = np.ones(tilt_series.num_tilts, dtype=np.bool_)
    for mode in get_args(Mode):
        with suppress(ValueError):  # images that cannot have this mode tell nothing of single tilts
            odd &= odd.any() and screen(replace(small, mode=mode)).odd
    return likely_mode(tilt_series.select(~odd) if odd.any() else tilt_series)


def require_specimen(tilt_series: TiltSeries) -> None:
    """Raise ValueError if at least half of the images of a series of nine tilts or more are blank."""
    count, blank = tilt_series.num_tilts, int(sum(np.ptp(image) == 0 for image in tilt_series.images))
    if 2 * blank >= count >= AROUND:
        raise ValueError(
            f"{blank} of {count} images are blank, with the same value in all pixels; give only tilts that show a specimen"
        )


def _blank(series: TiltSeries, order: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(tilts,) True for images with less than half of the structure, common to neighbouring rows, of those around them."""
    used = series.used
    flat = (series.images - series.images.mean((1, 2), where=used, keepdims=True)) * used
    structure, usual = neighbour_products(flat, axis=1).mean((1, 2)), np.empty(len(flat))
    usual[order] = median_filter(structure[order], min(AROUND, len(order)), mode="mirror")
    chance = LIKELY * (flat**2).mean((1, 2)) / math.sqrt(flat[0].size)
    return np.asarray(structure + chance < usual / 2)


def _fit_beam(
    series: TiltSeries, bad: NDArray[np.bool_], section: bool
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Relative intensities of all tilts, residuals of their normalised images, and predictions by a volume of the good tilts."""
    images, good = torch.from_numpy(series.images), torch.from_numpy(~bad)
    used = torch.from_numpy(series.used).float()
    width, depth = images.shape[2], images.shape[2] // (SIDES if section else 1)
    every = SliceProjector(tilt_angles=series.tilt_angles, depth=depth, width=width)
    some = SliceProjector(tilt_angles=series.tilt_angles[~bad], depth=depth, width=width)
    pedestal, volume = 0.0, None
    if series.mode == "linear":  # the value without beam, from the darkest areas, or behind a section without any
        behind = behind_section(series)
        pedestal = float(np.quantile(used_values(series), 0.02)) if behind is None else behind
    beam, above = torch.ones(series.num_tilts), images - pedestal
    for _ in range(ROUNDS):
        beam = _without_thickness(beam, series, good) if section else beam
        even = above / beam[:, None, None] + pedestal
        response = estimate_response(replace(series, images=even.numpy(), beam=None))
        with torch.no_grad():
            lines = response.invert(even[good]).contiguous()
            volume = sirt(lines, some, num_iterations=ITERATIONS, start=volume, used=used[good])
            predicted = response(every(volume).transpose(1, 2)).transpose(1, 2) - pedestal
        beam = (above * predicted * used).sum((1, 2)) / (predicted**2 * used).sum((1, 2)).clamp_min(1e-30)
        beam = (beam / beam[good].median()).clamp(0.1, 10)
    beam = _without_thickness(beam, series, good) if section else beam
    return beam.double().numpy(), (above / beam[:, None, None] - predicted).numpy(), predicted.numpy()


def _drifts(found: Screening, directions: Directions) -> NDArray[np.float64]:
    """The drift of the good tilts, and its part from tilt to tilt, without a smooth course as of matter that leaves the field."""
    beam = np.log(found.beam[directions.order[~found.bad[directions.order]]])
    # second differences of white noise have six times its variance
    return np.array([beam.std(), np.diff(beam, 2).std() / 6**0.5])


def _drift_by_chance(
    series: TiltSeries, found: Screening, section: bool, residual: NDArray[np.float32], predicted: NDArray[np.float32]
) -> NDArray[np.float64]:
    """The largest likely `_drifts` by noise in a series of a steady beam, with the residuals of the given one in random signs.

    Signs are those of tiles, as noise and misfit correlate. The fit follows a part of the noise, and again of that of the
    new series, which shows how much larger it was. The ratio of two equal variances has a standard error of 2 / √tilts.
    """
    tiles = [-(-size // TILE) for size in residual.shape[1:]]
    signs = np.random.default_rng(0).choice(np.array([-1, 1], np.float32), (len(residual), *tiles))
    signs[Directions.of(series.tilt_angles).order] = signs.copy()  # so that the order of the tilts changes nothing
    left = residual * found.beam[:, None, None].astype(np.float32)  # without the drift itself, which is no noise
    left *= signs.repeat(TILE, 1).repeat(TILE, 2)[:, : left.shape[1], : left.shape[2]] * series.used
    beam, again, _ = _fit_beam(series.with_images(predicted + left, series.mask), found.bad, section)
    unit = float(np.abs(predicted).max()) or 1.0  # fourth powers of small or large units leave single precision
    free = float(((predicted / unit * again * series.used) ** 2).sum() / ((predicted / unit * left) ** 2).sum())
    most = 1 + 2 * LIKELY / (~found.bad).sum() ** 0.5
    return np.asarray(_drifts(replace(found, beam=beam), Directions.of(series.tilt_angles)) * (most / free) ** 0.5)


def _without_thickness(beam: Tensor, series: TiltSeries, good: Tensor) -> Tensor:
    """The beam without what changes like the thickness of a tilted section: images do not tell one from the other."""
    # beyond it, rays leave the sides of the widened volume
    tilt = np.abs(np.cos(np.deg2rad(series.tilt_angles))).clip(1 / SIDES)
    slope, _ = np.polyfit(1 / tilt[good], beam.log().double().numpy()[good], 1, w=tilt[good])
    return beam * torch.from_numpy(np.exp(slope * (np.median(1 / tilt[good]) - 1 / tilt))).float()


def _negative_log_likelihood(
    residual: NDArray[np.float32], predicted: NDArray[np.float32], used: NDArray[np.bool_], good: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """NLL of each tilt, nats per used pixel, under Gaussian noise with the signal-dependent variance of the good tilts."""
    known = used & good[:, None, None]
    group = np.searchsorted(np.quantile(predicted[known], np.linspace(0, 1, 9)[1:-1]), predicted)
    squares = residual.astype(np.float64) ** 2
    sums, counts = (np.bincount(group[known], each, 8) for each in (squares[known], None))
    # without noise, the misfit of a coarse volume is the only residual, where it is least next to nothing
    variance = np.maximum(sums / np.maximum(counts, 1), max((HARMLESS["beam"] * predicted[known].std()) ** 2, 1e-30))
    # in empty parts, single counts are all the noise: the most that one pixel can say against its tilt
    terms = 0.5 * (np.minimum(squares / variance[group], 5.0**2) + np.log(2 * math.pi * variance[group]))
    return np.asarray(terms.mean((1, 2), where=used))
