"""Saturation and wrap-around: limits of the pixel values from the detector or the data type."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from noiseflow.statistics import robust_deviation
from recon.series.tilt_series import TiltSeries
from recon.verdict.residuals import Residuals
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_SATURATED = 0.005  # share of pixels whose complete neighbourhood is at a limit; noise around a limit gives 2⁻⁹
_BLANK = 0.3  # the same at the vacuum end, where a saturated neighbourhood loses only weak contrast
_PILE, _NEAR = (
    0.004,
    0.05,
)  # share of pixels at the limit of strong contrast, 0.0003 in standard scenes; neighbourhood, in ranges
_OF_NEAR = 0.6  # share of pixels near the limit: with noise around a limit, at least half of them are inside
_CLIFF, _BIN = (
    12.0,
    0.25,
)  # ratio of pixels below to above, 3.2 in standard scenes; bin width in standard deviations of the noise
_FEWEST, _PILED = 60, 0.5  # smallest number of pixels below a cliff; share of them at one value that means clipping
_ABOVE = 0.1  # largest share of pixels above it: steps in the middle belong to the object
_ADVICE = "use a series that is not saturated, or mask these parts"


def saturation(tilt_series: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Saturated pixels: complete neighbourhoods at the lowest or highest value, or too many pixels at the strong-contrast end."""
    ends = {"low": float(images.min()), "high": float(images.max())}
    empty = "low" if tilt_series.mode == "linear" else "high"
    shares = {name: float(np.mean(ndimage.minimum_filter(images == end, (1, 3, 3)))) for name, end in ends.items()}
    noisy = residuals.noise > 1e-3 * (ends["high"] - ends["low"])
    findings = []
    for name, share in shares.items():
        limit = _SATURATED if name != empty else _BLANK
        if share > limit and (noisy or name != empty) and (name != empty or tilt_series.mode == "transmission"):
            sentence = f"{share:.1%} of the pixels and all their neighbours are at the {name} limit, {ends[name]:.4g}"
            strength = 1 + 2 * min(1.0, share / (10 * limit))
            findings.append(Finding("saturation", strength, sentence, _ADVICE, "seen"))
    strong = "high" if empty == "low" else "low"
    pile, of_near = _pile(images, ends[strong])
    if pile > _PILE and of_near > _OF_NEAR:
        sentence = f"{pile:.1%} of the pixels are at the {strong} limit, {ends[strong]:.4g}, more than just inside it"
        findings.append(Finding("saturation", 1 + min(1.9, 20 * pile), sentence, _ADVICE, "seen"))
    return {"saturated": shares, "at the limit of contrast": pile}, findings


def _pile(images: Array, end: float) -> tuple[float, float]:
    """Share of pixels at an end, and their share of all pixels near it (at least to the next value)."""
    away = np.abs(images - np.float32(end))
    low, high = np.quantile(images, (0.01, 0.99))
    at, next_value = away == 0, float(away[away > 0].min(initial=np.inf))
    near = away <= max(_NEAR * float(high - low), next_value)
    return float(at.mean()), float(at.sum() / near.sum())


def cliff(_: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """An abrupt end of the brightest values without accumulation: brighter values wrapped around or were removed.

    The noise is four bins wide and smears every edge in the histogram of the object over more than one bin.
    """
    residual = residuals.residual
    width = _BIN * robust_deviation(residual)
    values, counts = np.unique(images, return_counts=True)
    if not np.median(np.diff(values[-_FEWEST:])) < width / 2:
        return {"cliff": 0.0}, []  # a histogram with so few values has steps of its own
    total = np.append(0, np.cumsum(counts))
    first = min(int(np.searchsorted(total, (1 - _ABOVE) * images.size)), len(values) - 1)
    tops, here = values[first:], total[first + 1 :]
    below = here - total[np.searchsorted(values, tops - width)]
    above = total[np.searchsorted(values, tops + width, "right")] - here
    countable = (below >= _FEWEST) & (counts[first:] < _PILED * below)
    ratios = np.where(countable, below / np.maximum(above, 1), 0.0)
    largest = int(np.argmax(ratios))
    ratio, top = float(ratios[largest]), float(tops[largest])
    if ratio < _CLIFF:
        return {"cliff": ratio}, []
    sentence = f"the pixel values end abruptly at {top:.4g}, as if brighter ones had wrapped around or been removed"
    advice = "check the data type in which the images were saved"
    return {"cliff": ratio}, [Finding("saturation", 2.0, sentence, advice, "seen")]
