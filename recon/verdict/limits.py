"""Where pixel values end: limits of the detector or of the number type that cut off what lies beyond."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.series.tilt_series import TiltSeries
from recon.verdict.residuals import Residuals
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_SATURATED = (
    0.005  # share of pixels amid a full neighbourhood at a limit; noise about a limit fills nine with chance 2⁻⁹
)
_BLANK = 0.3  # the same at the end of vacuum, where a full neighbourhood loses nothing but weak contrast
_PILE, _NEAR = 0.004, 0.05  # share of pixels at the limit of strong contrast, standard scenes 0.0003; ranges beside it
_OF_NEAR = 0.6  # of those beside it too: noise about a limit leaves at least half of them inside
_CLIFF, _BIN = 12.0, 0.25  # times fewer pixels above than below, standard scenes 3.2; bin in deviations of the noise
_FEWEST, _PILED = 60, 0.5  # pixels below a cliff, so that chance makes none; share of them at one value: clipping
_ABOVE = 0.1  # of the pixels may lie above it: steps in the middle are those of the object
_ADVICE = "use a series that is not saturated, or mask these parts"


def saturation(tilt_series: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Pixels at the lowest or highest value: amid others at it anywhere, or too many of them at the end of strong contrast."""
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
    """Share of the pixels at an end, and their share of all that lie near it: as far as the next value at least."""
    away = np.abs(images - np.float32(end))
    low, high = np.quantile(images, (0.01, 0.99))
    at, next_value = away == 0, float(away[away > 0].min(initial=np.inf))
    near = away <= max(_NEAR * float(high - low), next_value)
    return float(at.mean()), float(at.sum() / near.sum())


def cliff(_: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """A value at which the brightest pixels end abruptly, without a pile: those beyond it wrapped around, or were taken out.

    Noise of a width of four bins smears every edge of the object's histogram over more than one of them.
    """
    residual = residuals.residual
    width = _BIN * 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    values, counts = np.unique(images, return_counts=True)
    if not np.median(np.diff(values[-_FEWEST:])) < width / 2:
        return {"cliff": 0.0}, []  # a histogram of so few values has steps of its own
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
    advice = "check the number type in which the images were saved"
    return {"cliff": ratio}, [Finding("saturation", 2.0, sentence, advice, "seen")]
