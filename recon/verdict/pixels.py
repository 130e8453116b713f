"""Findings about pixel values: saturation, dead lines, spikes, and fixed detector patterns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from noiseflow.statistics import robust_deviation
from recon.series.tilt_series import TiltSeries
from recon.verdict.residuals import Residuals, neighbours
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_SPIKE = 5.0  # in ranges between the 0.5 and 99.5 % quantiles; noise with long tails reaches two
_PATTERN, _PATTERN_CONTRAST = (
    1.6,
    0.02,
)  # variance relative to that expected by chance; smallest relevant share of the contrast
_ALIKE = 0.2  # correlation of the fine pattern: single-pixel gains have −0.1 or less, misfit at edges 0.4 and more
_STEADY = 0.03  # share of the structure common to the residuals of all tilts; standard scenes reach 0.019
_STEADY_CHANCE, _STEADY_PART = (
    15.0,
    0.3,
)  # standard errors; share of the residual structure, at most 0.2 if tilts are shifted
_SIGNALS = 16  # number of equally populated bins: finer than smooth misfit
_STREAK = (
    8.0  # typical deviations of the mean residual of a line from its neighbours; by chance, four in thousands of lines
)
_STREAKS = 0.002  # of all lines: one in five hundred is harmless
_REGION = 0.002  # of the pixels: one in five hundred is harmless, and no pixel is constant by chance
_CHANCE = 1e-3  # of a line of equal counts
_BORDERS = 0.1  # of the images: fewer are single defects, which screening removes
_SEAM, _SEAM_STEP = (
    12.0,
    0.25,
)  # typical steps between columns; in standard deviations of all pixels, at most 0.13 in good series
_BLOCK, _BLOCKS = 8, 1.6  # block size, pixels; ratio of steps at borders to those inside, 1.15 in good series
_DEAD, _STEP = (
    0.1,
    0.1,
)  # standard deviation of a dead line relative to others; its step to its neighbours relative to the range


def spikes(tilt_series: TiltSeries, images: Array, _: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Pixels far outside the range of the others."""
    low, high = (float(end) for end in np.quantile(images[:: max(1, len(images) // 16)], (0.005, 0.995)))
    far = float(np.mean(np.abs(images - (low + high) / 2) > _SPIKE * max(high - low, 1e-30)))
    if far == 0 or high <= low:
        return {"spikes": far}, []
    sentence = f"{far:.2%} of the pixels deviate from the others by more than {_SPIKE:g} times their range"
    strength = 1.5 + min(1.4, 500 * far)
    return {"spikes": far}, [
        Finding("outliers", strength, sentence, "mask the spikes with --mask FILE, or replace them", "seen")
    ]


def lines(_: TiltSeries, images: Array, __: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Rows and columns that hardly vary."""
    span = float(np.quantile(images, 0.99) - np.quantile(images, 0.01))
    dead = {"rows": _dead(images.transpose(1, 0, 2), span), "columns": _dead(images.transpose(2, 0, 1), span)}
    findings = []
    for name, count in dead.items():
        if count:
            size = images.shape[1 if name == "rows" else 2]
            strength = 1.5 + min(2.0, 20 * count / size)
            sentence = f"{count} of {size} {name} have a constant value in all tilts, unlike their neighbours"
            findings.append(Finding("lines", strength, sentence, "mask them with --mask FILE", "seen"))
    return {"dead lines": dead}, findings


def region(_: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Pixels with a constant value in all tilts. At a limit of the values, where vacuum or saturation may be the cause, only
    pixels that differ from their surroundings count."""
    ends = float(images.min()), float(images.max())
    constant = (images.max(0) == images.min(0)) & (residuals.residual != 0).any(
        0
    )  # residuals of masked pixels are zero
    dead = constant & ~np.isin(images[0], ends)
    span, mean = float(np.quantile(images, 0.99) - np.quantile(images, 0.01)), images.mean(0)
    for end in ends:
        regions, count = ndimage.label(constant & (images[0] == end))
        for number in range(1, count + 1):
            around = ndimage.binary_dilation(regions == number) & ~constant
            if around.any() and abs(float(np.median(mean[around])) - end) > _STEP * span:
                dead |= regions == number
    share = float(dead.mean())
    if constant.all() or share < _REGION:
        return {"dead pixels": share}, []
    sentence = f"{share:.1%} of the pixels have a constant value in all tilts, unlike those around them"
    strength = 1.5 + min(1.4, 10 * share)
    return {"dead pixels": share}, [Finding("lines", strength, sentence, "mask them with --mask FILE", "seen")]


def streaks(_: TiltSeries, __: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Rows or columns of single images whose mean residual differs from their neighbours by as much as the projections vary."""
    counts = {}
    for name, axis in (("rows", 2), ("columns", 1)):
        means = residuals.residual.mean(axis)
        apart = np.abs(means - ndimage.median_filter(means, (1, 5), mode="nearest"))
        usual = robust_deviation(apart, 0.0)
        counts[name] = int((apart > np.maximum(_STREAK * usual, residuals.contrast)).sum())
    name = max(counts, key=lambda each: counts[each])
    share = counts[name] / residuals.residual[..., 0].size
    if share < _STREAKS:
        return {"streaks": counts}, []
    sentence = f"{counts[name]} {name} of single images differ from their neighbours"
    advice = "mask them with --mask FILE, or exclude these images"
    return {"streaks": counts}, [Finding("lines", 1 + min(2.0, 50 * share), sentence, advice, "seen")]


def borders(_: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Borders of single images with a constant value, unlike the adjacent pixels, as left by an alignment."""
    span = float(np.quantile(images, 0.99) - np.quantile(images, 0.01))
    seen = np.where(residuals.used, images, np.nan)  # what is masked was filled on purpose
    sides = seen.transpose(0, 2, 1), seen.transpose(0, 2, 1)[:, ::-1]  # (tilt, lines from the side, pixels along it)
    filled = np.mean([_filled(side, span) for side in sides], axis=0)
    share = float((filled > 0).mean())
    evidence = {"filled borders": share}
    if share < _BORDERS:
        return evidence, []
    sentence = (
        f"{share:.0%} of the images have borders with a constant value, up to {filled.max():.0f} pixels wide on average"
    )
    return evidence, [Finding("lines", 2.0, sentence, "mask these borders with --mask FILE", "seen")]


def _filled(lines: Array, span: float) -> Array:
    """(tilt,) number of leading lines with a constant value that differs clearly from the next line, and that counts in an image
    mostly without electrons would not have by chance."""
    flat = (lines.max(2) == lines.min(2)) & (lines[:, :, 0] == lines[:, :1, 0])
    alike = (lines == lines[:, :1, :1]).mean((1, 2))  # of the pixels
    flat &= (alike ** lines.shape[2] < _CHANCE)[:, None]
    count = np.argmin(flat, axis=1)
    after = lines[np.arange(len(lines)), count].mean(1)
    return np.where(np.abs(after - lines[:, 0, 0]) > _STEP * span, count, 0)


def _dead(lines: Array, span: float) -> int:
    """Number of lines that hardly vary and differ from their neighbours."""
    spread, mean = lines.std((1, 2)), lines.mean((1, 2))
    apart = np.abs(mean - ndimage.median_filter(mean, 5, mode="nearest")) > _STEP * span
    return int((apart & (spread < _DEAD * np.median(spread))).sum())


def seam(_: TiltSeries, images: Array, __: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """A step between two columns in the mean of all tilts, in which edges of the object are smeared out."""
    steps = np.diff(images.mean((0, 1), dtype=np.float64))
    apart = np.abs(steps - ndimage.median_filter(steps, 5, mode="nearest"))
    usual, where = robust_deviation(apart, 0.0), int(np.argmax(apart))
    size = float(apart[where] / max(float(images.std()), 1e-30))
    evidence = {"largest step between columns": size}
    if size < _SEAM_STEP or apart[where] < _SEAM * usual:
        return evidence, []
    words = (
        f"all images have a step between columns {where} and {where + 1}, as at the border of two parts of a detector"
    )
    return evidence, [Finding("pattern", 2.0, words, "correct the images with flats and darks first", "seen")]


def blocks(_: TiltSeries, images: Array, __: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Steps at the borders of pixel blocks, along y and u, from lossy compression such as JPEG."""
    ratios = []
    for axis in (1, 2):
        steps = np.abs(np.diff(images, axis=axis)).mean((0, 3 - axis), dtype=np.float64)
        border = np.arange(len(steps)) % _BLOCK == _BLOCK - 1
        ratios.append(float(steps[border].mean() / max(steps[~border].mean(), 1e-30)) if border.any() else 0.0)
    evidence = {"steps at blocks": min(ratios)}
    if min(ratios) < _BLOCKS:
        return evidence, []
    words = (
        f"pixel values step at the borders of blocks of {_BLOCK} pixels, {min(ratios):.1f} times as much as inside them"
    )
    return evidence, [Finding("pattern", 2.9, words, "use images without lossy compression", "seen")]


def pattern(_: TiltSeries, __: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Fine structure of the mean residual over the tilts, compared with that expected for independent tilts."""
    fine = residuals.residual - ndimage.uniform_filter(residuals.residual, (0, 3, 3), mode="nearest")
    mean = fine.mean(0, keepdims=True)
    steady = float(np.var(mean))
    alike = max(neighbours(mean, axis) for axis in (1, 2)) / max(steady, 1e-30)
    ratio = steady * len(fine) / max(float(np.var(fine)), 1e-30)
    evidence = {
        "fixed pattern": {
            "over chance": ratio,
            "neighbours alike": alike,
            "share of contrast": float(np.sqrt(steady)) / max(residuals.contrast, 1e-30),
        }
    }
    size = evidence["fixed pattern"]["share of contrast"]
    if ratio < _PATTERN or size < _PATTERN_CONTRAST or alike > _ALIKE:
        return evidence, []
    sentence = (
        f"the residuals contain a fixed detector pattern: {size:.1%} of the contrast, {ratio:.1f} times that of chance"
    )
    return evidence, [
        Finding("pattern", min(2.9, ratio / _PATTERN), sentence, "correct the images with flats and darks first")
    ]


def uneven(_: TiltSeries, images: Array, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Smooth structure common to all residuals: uneven illumination or detector response."""
    residual = residuals.residual - _by_signal(images - residuals.residual, residuals.residual)
    mean = residual.mean(0, keepdims=True)
    steady, power = neighbours(mean, 1), float(np.mean(residual**2))
    share = steady / max(neighbours(images - images.mean(), 1), 1e-30)
    score = steady * len(images) * float(np.sqrt(mean.size)) / max(power, 1e-30)
    part = steady / max(neighbours(residual, 1), 1e-30)
    evidence = {"steady structure": {"share": share, "score": score, "part": part}}
    if share < _STEADY or score < _STEADY_CHANCE or part < _STEADY_PART:
        return evidence, []
    sentence = f"all residuals contain the same smooth structure, {share:.1%} of that of the images, at every tilt"
    advice = "correct the images with flats and darks, or for uneven illumination"
    return evidence, [Finding("pattern", min(2.9, share / _STEADY), sentence, advice)]


def _by_signal(signal: Array, residual: Array) -> Array:
    """The mean residual at each pixel's signal, as caused by clipping that a method does not model."""
    edges = np.quantile(signal, np.linspace(0, 1, _SIGNALS + 1)[1:-1])
    bins = np.searchsorted(edges, signal)
    counts = np.bincount(bins.ravel(), minlength=_SIGNALS)
    sums = np.bincount(bins.ravel(), weights=residual.ravel(), minlength=_SIGNALS)
    return (sums / np.maximum(counts, 1))[bins]
