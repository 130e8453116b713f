"""How far the figures can be believed: every assumption tested, and a grade with its reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.figures import (
    LARGEST_DISAGREEMENT,
    LARGEST_MISFIT,
    LARGEST_UNEVENNESS,
    Figures,
    correctable,
    disagrees,
)
from calibration.detector.independence import contained_share, correlation_in_time
from calibration.detector.measure import Detector
from calibration.detector.repair import LEAST_SHARE, Repairs
from calibration.detector.shape import field_deviation
from calibration.exposures.codes import MOST_JOINED
from calibration.exposures.compression import block_compressed, wavelet_compressed
from calibration.exposures.frames import Image, rails
from calibration.registration.aligned import AlignedPair
from noiseflow.described import described

Grade = Literal["good", "doubtful", "bad"]
GRADES: tuple[Grade, ...] = ("good", "doubtful", "bad")

LEAST_MISFIT = 0.8
"""χ² per degree of freedom below which the histograms are more even than independent pixels can be: over the thousand cells of
a usual calibration it scatters by 0.05. Bursts share their frames, which takes some scatter away."""

WIDEST_GAIN = 0.03
"""Half-width of the gain's 90 % interval, relative, above which too few electrons or too little contrast were recorded:
twice the goal."""

BIAS = 0.02
"""Relative error of the gain that may go without a warning: the goal of the calibration."""

MOST_UNEVEN_CODES = 0.05
"""Relative deviation of the converter's code widths, from which on a user should know: good converters keep within a few
percent of a step, and the entropy of the noise moves by half its square, a thousandth of a nat."""

MOST_UNEVEN_FIELD = 0.04
"""Relative deviation of the noise's variance across the field, from which on one gain does not describe it: twice the goal, since
residuals at levels of few electrons are standardised to 2 %."""

MOST_CHANGED = 0.005
"""Share of the pixels in places that change, from which on the user should know that they were left out."""


BINS = 32
"""Of the upper half of a histogram that is searched for a second mode."""


@described()
@dataclass(frozen=True)
class Reason:
    """One test that did not pass.

    Attributes:
        name: short, for programs.
        grade: ``"doubtful"`` or ``"bad"``.
        text: a sentence: what was found, what it does to the figures, and the fix.
    """

    name: str
    grade: Grade
    text: str


@described()
@dataclass(frozen=True)
class Verdict:
    """How far gain, offset and read noise can be believed.

    Attributes:
        grade: ``"good"``; ``"doubtful"``: corrected or uncertain, as the reasons say; ``"bad"``: do not use.
        reasons: what was found, worst first; empty for a good calibration.
    """

    grade: Grade
    reasons: tuple[Reason, ...]


def judge_calibration(
    pairs: Sequence[AlignedPair], detector: Detector, figures: Figures, correlation: Correlation, repairs: Repairs
) -> Verdict:
    """Test what the figures assume.

    Args:
        pairs: as measured, after repairs.
        detector: measured.
        figures: as reported.
        correlation: of the residuals of `pairs`.
        repairs: what was modelled before.
    """
    reasons = [
        *_scene(repairs, correlation),
        *_independence(pairs),
        *_correlation(pairs, correlation, repairs, figures, detector.electrons),
        *_shape(detector, figures),
        *_range(pairs, detector, figures, repairs),
    ]
    return verdict_of(reasons)


def verdict_of(reasons: Sequence[Reason]) -> Verdict:
    """The verdict of some reasons: as bad as the worst."""
    ordered = sorted(reasons, key=lambda one: -GRADES.index(one.grade))
    return Verdict(ordered[0].grade if ordered else "good", tuple(ordered))


def _scene(repairs: Repairs, correlation: Correlation) -> list[Reason]:
    found = []
    if repairs.changed > MOST_CHANGED:
        grade: Grade = "bad" if repairs.changed > 0.2 else "doubtful"
        text = f"{repairs.changed:.1%} of the pixels lie in places that changed between the exposures and were left out"
        found.append(
            Reason("scene changed", grade, text + ". Check the residual map, or record a scene that does not move.")
        )
    causes = {
        "blur": "blur, drift or another focus of one exposure",
        "illumination": "light or dose that changed across the field",
        "response": "an exposure that is not linear in the signal",
    }
    before = max(repairs.scene, key=lambda one: one.largest[1], default=None)
    after = max(repairs.scene_after, key=lambda one: one.largest[1], default=None)
    if before is None or after is None or not (before.clear and before.largest[1] > LEAST_SHARE):
        return found
    name, share = before.largest
    text = f"{share:.1%} of the residual's variance follows the scene: {causes[name]}"
    left = after.clear and after.largest[1] > LEAST_SHARE
    if not repairs.refitted:
        found.append(
            Reason("scene misfit", "bad" if share > 5 * LEAST_SHARE else "doubtful", text + " (not modelled).")
        )
    elif left or correlation.found:
        text += ". A kernel fitted between the exposures does not explain it completely: repeat the exposures"
        found.append(Reason("scene misfit", "bad", text + "."))
    else:
        text += (
            ". A kernel fitted between the exposures explains it; the corrected figures are uncertain by a few percent"
        )
        found.append(Reason("scene misfit", "doubtful", text + "."))
    return found


def _correlation(
    pairs: Sequence[AlignedPair], correlation: Correlation, repairs: Repairs, figures: Figures, electrons: bool
) -> list[Reason]:
    found = []
    for name, deviation in (("rows", repairs.rows), ("columns", repairs.columns)):
        if deviation:
            text = f"{name} have individual offsets, {deviation:.3g} counts rms; they were subtracted before the measurement"
            found.append(Reason(f"{name[:-1]} offsets", "doubtful", text + ". ScanNoise(model) models them."))
    if electrons:  # which no filter leaves, and which tell the gain whatever correlates
        return found
    if correlation.found and (abs(correlation.factor - 1) > BIAS or not correlation.local):
        lag = int(np.argmax(np.abs(correlation.value)))
        distance, value = tuple(int(step) for step in correlation.lags[lag]), correlation.value[lag]
        text = (
            f"pixels at the distance (y, x) = {distance} have a correlation of {value:+.3f}: the frames were filtered "
        )
        text += "or resampled, or contain afterglow or interference"
        if correctable(correlation, repairs):
            text += (
                f". If this keeps the mean, the variance before it was {figures.factor:.3g} times as large. The reported gain "
                "is that before it; per pixel of the recorded frame the gain is "
                f"{figures.gain.median / figures.factor:.3g} counts/e⁻. Give raw frames to be sure"
            )
            grade: Grade = (
                "bad" if correlation.factor < 0.5 else "doubtful"
            )  # a sharpened frame: its factor is hardly known
        else:
            grade, text = "bad", text + ", which no short filter explains. Give raw frames, or remove the interference"
        found.append(Reason("correlated pixels", grade, text + "."))
    found += compression(pairs)
    if correlation.period:
        text = f"the noise is periodic, every {correlation.period:.3g} pixels: the frames were resampled "
        if correlation.step != 1 and correctable(correlation, repairs):
            text += f"by {1 / correlation.step:.2g} with linear interpolation; the gain is corrected for it, to a few percent"
            grade = "doubtful"
        else:
            text, grade = text + "or compressed, so that the gain is not that of the camera", "bad"
        found.append(Reason("periodic noise", grade, text + ". Give raw frames."))
    return found


def _independence(pairs: Sequence[AlignedPair]) -> list[Reason]:
    found = []
    found += frames_correlated(correlation_in_time(pairs))
    share = max(map(contained_share, pairs))
    if share > BIAS:
        text = f"{share:.1%} of the long exposure's signal is the short exposure itself: the long one is a mean or sum of frames "
        text += "with the short one among them, and the gain is too low by as much"
        found.append(Reason("short contained", "bad", text + ". Give a short exposure that is none of them."))
    return found


def frames_correlated(lag: float) -> list[Reason]:
    """What a correlation of successive frames does to the gain."""
    if abs(lag) <= BIAS / 2:  # it takes twice itself off the variance
        return []
    text = (
        f"the noise of successive frames correlates by {lag:+.3f}: image lag, a filter over time, or a changing scene; "
    )
    text += f"the gain is off by about {abs(2 * lag):.0%}"
    grade: Grade = "bad" if abs(lag) > 5 * BIAS / 2 else "doubtful"
    end = ". Take frames apart in time, without averaging in the camera."
    return [Reason("frames correlated", grade, text + end)]


def compression(pairs: Sequence[AlignedPair]) -> list[Reason]:
    """Whether the first frame, or its long exposure, went through lossy compression."""
    first = pairs[0]
    looked_at: tuple[tuple[Image, str, Grade], ...] = (
        (first.short, "frame", "bad"),
        (first.long, "long exposure", "doubtful"),
    )
    for frame, name, grade in looked_at:
        kind = "in blocks of 8 × 8 pixels (JPEG)" if block_compressed(frame) else ""
        kind = kind or (
            "by wavelets (JPEG 2000), or interpolated between every second pixel," if wavelet_compressed(frame) else ""
        )
        if kind and (name == "frame" or first.frames == 1):
            text = (
                f"the {name} was compressed {kind} or the like, which removes noise and adds its own. Give raw frames."
            )
            return [Reason("compressed", grade, text)]
    return []


def _shape(detector: Detector, figures: Figures) -> list[Reason]:
    found = []
    line, gain = detector.line, detector.posterior.gain.median
    by_line = " The reported gain is that of photon transfer, which applies to any detector of independent events"
    by_line += ", times the excess-noise factor" + (
        "; without dark frames offset and read noise are not determined." if detector.offset is None else "."
    )
    if detector.misfit > LARGEST_MISFIT:
        text = f"the histograms are not those of a Poisson-Gaussian detector (χ² per degree of freedom {detector.misfit:.2f})."
        found.append(Reason("not Poisson-Gaussian", "bad" if detector.misfit > 3 else "doubtful", text + by_line))
    if detector.misfit < LEAST_MISFIT:
        text = f"the histograms are more even than independent pixels can be (χ² per degree of freedom {detector.misfit:.2f})"
        found.append(Reason("too even", "doubtful", text + ": values were rescaled or filtered. Give raw frames."))
    if disagrees(detector):
        text = f"the gain is {gain:.4g} counts/e⁻ by the shape of the noise and {line.gain:.4g} by its variance."
        grade: Grade = "bad" if abs(gain / line.gain - 1) > 5 * LARGEST_DISAGREEMENT else "doubtful"
        found.append(Reason("shape against variance", grade, text + by_line))
    if detector.codes > MOST_UNEVEN_CODES:
        text = (
            f"the converter's codes are uneven: their widths differ by {detector.codes:.0%} rms from their neighbours'"
        )
        text += (
            ". Frames that were rescaled and rounded again show this, and so do cameras that combine two converters. "
        )
        text += "Gain and variance hardly change, but a noise model that rounds evenly does not reproduce these steps"
        found.append(Reason("uneven codes", "doubtful", text + ". If the frames are not raw, give the raw ones."))
    if detector.uneven > LARGEST_UNEVENNESS:
        text = (
            f"the variances of single pixels differ by {detector.uneven:.0%} rms at equal signal (sCMOS, hot pixels)."
        )
        found.append(Reason("uneven pixels", "doubtful", text + " Flats and darks give per-pixel maps." + by_line))
    if line.bent:
        text = "the variance does not grow linearly with the signal: saturation, a rescaled converter, or light that changed"
        found.append(Reason("bent line", "doubtful", text + ". Look at the photon-transfer plot."))
    return found


def _range(pairs: Sequence[AlignedPair], detector: Detector, figures: Figures, repairs: Repairs) -> list[Reason]:
    found = []
    if repairs.joined:
        text = f"pixels brighter than {repairs.join:.5g} counts ({repairs.joined:.1%}) use fewer of the converter's codes: two "
        text += "converters joined into one frame (high dynamic range), or companded values. "
        few = repairs.joined <= MOST_JOINED
        text += (
            "They were treated as clipped: figures and noise models are those of the darker pixels"
            if few
            else "No gain fits both"
        )
        found.append(
            Reason("joined converters", "doubtful" if few else "bad", text + ". Record with one converter setting.")
        )
    gain = figures.gain
    half = (gain.q95 - gain.q05) / (2 * gain.median)
    if half > WIDEST_GAIN:
        text = f"the uncertainty of the gain is ±{half:.0%}; give more exposures, more contrast, or flats at several levels"
        found.append(Reason("gain uncertain", "doubtful", text + "."))
    field = field_deviation(pairs)
    if field > MOST_UNEVEN_FIELD:
        text = f"at equal signal the noise's variance differs by {field:.0%} rms across the field: the frames were divided by a "
        text += "flat field or corrected for shading, so that no single gain applies"
        found.append(Reason("uneven field", "doubtful", text + ". Give the uncorrected frames."))
    for pair in pairs:
        if pair.exposure_ratio is not None and not pair.one_setting:
            text = f"the exposures' scale is {1 / pair.scaling.slope:.3g}, not the given ratio of {pair.exposure_ratio:.3g}. "
            text += "The ratio was not used: it is wrong, or the exposures differ in gain or processing"
            found.append(Reason("exposure ratio", "doubtful", text + ". Check --exposure-ratio, or leave it out."))
            break
    shares = [full_share(pair) for pair in pairs]
    if max(shares) > 0.001:
        text = (
            f"{max(shares):.1%} of the pixels pile up at the brightest values, below the converter's end: a full well"
        )
        found.append(Reason("saturation", "doubtful", text + ". Use a shorter exposure."))
    return found


def full_share(pair: AlignedPair) -> float:
    """Share of pixels in a pile at the upper end of the histogram that no clipping limit explains.

    The brightest values of a scene thin out; a full well, with read noise after it, ends the histogram in a second mode.
    """
    if np.isfinite(rails(pair.short)[1]):
        return 0.0
    values = pair.short[pair.mask]
    low, high = np.percentile(values, (50, 99.99))
    width = max(1.0, np.ceil((high - low) / BINS))  # whole counts, or the histogram beats with the converter's steps
    counts, _ = np.histogram(values, low - 0.5 + width * np.arange(BINS + 1))
    smooth = np.convolve(counts, np.ones(3) / 3, mode="same")
    last = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    peak = BINS // 4 + int(np.argmax(smooth[BINS // 4 :]))
    valley = BINS // 8 + int(np.argmin(smooth[BINS // 8 : peak + 1]))
    second = peak > 0.6 * last and smooth[peak] > 3 * (smooth[valley] + np.sqrt(smooth[valley]) + 1)
    return float(counts[valley:].sum() / values.size) if second else 0.0
