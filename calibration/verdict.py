"""Reliability of the results: tests of every assumption, and a grade with its reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
from calibration.detector.patterns import Pattern, pattern_of
from calibration.detector.repair import LEAST_SHARE, Repairs
from calibration.detector.residual import residual_of
from calibration.detector.response import Response
from calibration.exposures.codes import MOST_JOINED
from calibration.exposures.compression import block_compressed, wavelet_compressed
from calibration.exposures.frames import Image, rails
from calibration.registration.aligned import AlignedPair
from noiseflow.checks import Grade, Verdict
from noiseflow.described import described

GRADES: tuple[Grade, ...] = ("good", "doubtful", "bad")

LEAST_MISFIT = 0.8
"""χ² per degree of freedom below which the histograms scatter less than those of independent pixels can. It varies by 0.05 over
the roughly 1000 cells of a typical calibration. The frames of a burst share their mean, which reduces the scatter a little."""

BIAS = 0.02
"""Largest relative error of the gain without a warning: the target accuracy of the calibration."""

MOST_UNEVEN_CODES = 0.05
"""Largest relative deviation of the converter's code widths without a warning. Good converters stay within a few percent of a
step. The entropy of the noise changes by half the square of the deviation: a thousandth of a nat."""

MOST_UNEVEN_FIELD = 0.04
"""Relative deviation of the noise variance across the field above which one gain does not describe the field: twice the target
accuracy, because residuals at levels of few electrons are standardised to 2 %."""

MOST_CHANGED = 0.005
"""Largest share of pixels in changing regions that is excluded without a warning."""

BINS = 32
"""Number of bins in the upper half of the histogram, which is searched for a second mode."""


@described()
@dataclass(frozen=True)
class Reason:
    """A failed test.

    Attributes:
        name: short identifier, for programs.
        grade: ``"doubtful"`` or ``"bad"``.
        text: what was found, how it affects the results, and what to do.
    """

    name: str
    grade: Grade
    text: str

    @property
    def reason(self) -> str:
        """The name, as that of other findings."""
        return self.name


def judge_calibration(
    pairs: Sequence[AlignedPair], detector: Detector, figures: Figures, correlation: Correlation, repairs: Repairs
) -> Verdict[Reason]:
    """Test the assumptions behind the results.

    Args:
        pairs: the pairs that were measured, after repairs.
        detector: the measured detector.
        figures: the reported results.
        correlation: correlation of the residuals of `pairs`.
        repairs: violated assumptions that were modelled before the measurement.
    """
    shared = pairs[0].frames / max(pairs[0].frames - 1, 1)  # residuals from a mean that the frames of a burst share
    pattern = pattern_of([residual_of(pair) for pair in pairs], inflation=correlation.inflation * np.sqrt(shared))
    reasons = [
        *_scene(repairs, correlation),
        *_independence(pairs),
        *_correlation(pairs, correlation, repairs, figures, detector.electrons),
        *_shape(detector, figures),
        *_range(pairs, detector, figures, repairs),
    ]
    return verdict_of(with_pattern(reasons, pattern, correlation, figures.gain.median))


def verdict_of(reasons: Sequence[Reason]) -> Verdict[Reason]:
    """Return the verdict for these reasons: its grade is the worst of theirs."""
    ordered = sorted(reasons, key=lambda one: -GRADES.index(one.grade))
    texts = tuple(one.text for one in ordered)
    return Verdict(ordered[0].grade if ordered else "good", texts, findings=tuple(ordered))


def _scene(repairs: Repairs, correlation: Correlation) -> list[Reason]:
    found = []
    if repairs.changed > MOST_CHANGED:
        grade: Grade = "bad" if repairs.changed > 0.2 else "doubtful"
        text = (
            f"{repairs.changed:.1%} of the pixels lie in regions that changed between the exposures and were excluded"
        )
        found.append(Reason("scene changed", grade, text + ". Check the residual map, or record a static scene."))
    causes = {
        "blur": "one exposure is blurred, drifted or differs in focus",
        "illumination": "light or dose changed across the field",
        "response": "one exposure is not linear in the signal",
    }
    before = max(repairs.scene, key=lambda one: one.largest[1], default=None)
    after = max(repairs.scene_after, key=lambda one: one.largest[1], default=None)
    if before is None or after is None or not (before.clear and before.largest[1] > LEAST_SHARE):
        return found
    name, share = before.largest
    text = f"{share:.1%} of the residual variance follows the scene; likely cause: {causes[name]}"
    left = after.clear and after.largest[1] > LEAST_SHARE
    if not repairs.refitted:
        found.append(
            Reason("scene misfit", "bad" if share > 5 * LEAST_SHARE else "doubtful", text + " (not modelled).")
        )
    elif left or correlation.found:
        text += ". A convolution kernel fitted between the exposures removes only part of it. Repeat the exposures"
        found.append(Reason("scene misfit", "bad", text + "."))
    else:
        text += ". A convolution kernel fitted between the exposures corrects it; expect errors of a few percent in the results"
        found.append(Reason("scene misfit", "doubtful", text + "."))
    return found


def _correlation(
    pairs: Sequence[AlignedPair], correlation: Correlation, repairs: Repairs, figures: Figures, electrons: bool
) -> list[Reason]:
    found = []
    for name, deviation in (("rows", repairs.rows), ("columns", repairs.columns)):
        if deviation:
            text = f"{name} have individual offsets of {deviation:.3g} counts rms, which were subtracted before the measurement"
            found.append(Reason(f"{name[:-1]} offsets", "doubtful", text + ". Use ScanNoise(model) to model them."))
    if electrons:  # no filter leaves these peaks intact, and they determine the gain in spite of any correlation
        return found
    if correlation.found and (abs(correlation.factor - 1) > BIAS or not correlation.local):
        lag = int(np.argmax(np.abs(correlation.value)))
        distance, value = tuple(int(step) for step in correlation.lags[lag]), correlation.value[lag]
        text = f"the noise of pixels at a distance of (y, x) = {distance} has a correlation of {value:+.3f}: the frames were "
        text += "filtered or resampled, or contain afterglow or interference"
        if correctable(correlation, repairs):
            text += (
                f". If a filter that preserves the mean is the cause, the variance before it was {figures.factor:.3g} times as "
                "large. The reported gain applies before the filter; the gain per pixel of the recorded frames is "
                f"{figures.gain.median / figures.factor:.3g} counts/e⁻. Use raw frames to be sure"
            )
            # the factor of a sharpened frame is poorly known
            grade: Grade = "bad" if correlation.factor < 0.5 else "doubtful"
        else:
            grade, text = "bad", text + ". No short filter explains it. Use raw frames, or remove the interference"
        found.append(Reason("correlated pixels", grade, text + "."))
    if correlation.period:
        text = f"the noise is periodic, with a period of {correlation.period:.3g} pixels: the frames were resampled "
        if correlation.step != 1 and correctable(correlation, repairs):
            text += f"by {1 / correlation.step:.2g} with linear interpolation; the gain is corrected to within a few percent"
            grade = "doubtful"
        else:
            text, grade = text + "or compressed, so the gain is not that of the camera", "bad"
        found.append(Reason("periodic noise", grade, text + ". Use raw frames."))
    return found


def _independence(pairs: Sequence[AlignedPair]) -> list[Reason]:
    found = []
    found += frames_correlated(correlation_in_time(pairs))
    share = max(map(contained_share, pairs))
    if share > BIAS:
        text = f"{share:.1%} of the long exposure's signal is the short exposure itself: the long exposure is a mean or sum of "
        text += "frames that include the short one, and the gain is too low by the same share"
        found.append(
            Reason("short contained", "bad", text + ". Use a short exposure that is not part of the long one.")
        )
    return found


def frames_correlated(lag: float) -> list[Reason]:
    """Return the reason to report for a correlation `lag` between successive frames, if the gain suffers from it."""
    if abs(lag) <= BIAS / 2:  # a correlation reduces the variance by twice its value
        return []
    text = f"the noise of successive frames has a correlation of {lag:+.3f} (image lag, temporal filter or changing scene); "
    text += f"the gain is wrong by about {abs(2 * lag):.0%}"
    grade: Grade = "bad" if abs(lag) > 5 * BIAS / 2 else "doubtful"
    end = ". Leave more time between frames, and switch off averaging in the camera."
    return [Reason("frames correlated", grade, text + end)]


def compression(short: Image, long: Image | None = None) -> list[Reason]:
    """Test whether a frame or its long exposure was compressed with loss.

    Args:
        short: (y, x) raw frame; of a burst the first one.
        long: (y, x) raw long exposure, if there is one.
    """
    looked_at: list[tuple[Image, str, Grade]] = [(short, "frame", "bad")]
    looked_at += [] if long is None else [(long, "long exposure", "doubtful")]
    for frame, name, grade in looked_at:
        if block_compressed(frame):
            kind = "in blocks of 8 × 8 pixels (JPEG)"
        elif wavelet_compressed(frame):
            kind = "by wavelets (JPEG 2000), or every second pixel was interpolated"
        else:
            continue
        text = f"the {name} was compressed with loss {kind}, which removes noise and adds artefacts. Use raw frames."
        return [Reason("compressed", grade, text)]
    return []


def _shape(detector: Detector, figures: Figures) -> list[Reason]:
    found = []
    line, gain = detector.line, detector.posterior.gain.median
    by_line = (
        " The reported gain is that of photon transfer, which is valid for any detector of independent events; it "
    )
    by_line += "includes the excess-noise factor." + (
        " Add dark frames to determine offset and read noise." if detector.offset is None else ""
    )
    if detector.misfit > LARGEST_MISFIT:
        text = "the histograms do not fit a Poisson-Gaussian detector "
        text += f"(χ² per degree of freedom {detector.misfit:.2f})."
        found.append(Reason("not Poisson-Gaussian", "bad" if detector.misfit > 3 else "doubtful", text + by_line))
    if detector.misfit < LEAST_MISFIT:
        text = "the histograms scatter less than those of independent pixels "
        text += f"(χ² per degree of freedom {detector.misfit:.2f}): the values were rescaled or filtered"
        found.append(Reason("too even", "doubtful", text + ". Use raw frames."))
    if disagrees(detector):
        text = (
            f"the shape of the noise distribution gives a gain of {gain:.4g} counts/e⁻, its variance {line.gain:.4g}."
        )
        grade: Grade = "bad" if abs(gain / line.gain - 1) > 5 * LARGEST_DISAGREEMENT else "doubtful"
        found.append(Reason("shape against variance", grade, text + by_line))
    if detector.codes > MOST_UNEVEN_CODES:
        text = f"the converter's codes are uneven: the width of each differs by {detector.codes:.0%} rms from its neighbours"
        text += ". Typical causes are frames that were rescaled and rounded again, and cameras that combine two converters. "
        text += (
            "Gain and variance hardly change, but a noise model with equal rounding steps does not reproduce the codes"
        )
        found.append(Reason("uneven codes", "doubtful", text + ". Use raw frames if these are not raw."))
    if detector.uneven > LARGEST_UNEVENNESS:
        text = f"the variances of individual pixels differ by {detector.uneven:.0%} rms at equal signal (sCMOS, hot pixels)."
        found.append(
            Reason("uneven pixels", "doubtful", text + " Calibrate with flats and darks for per-pixel maps." + by_line)
        )
    if line.bent:
        text = "the variance is not linear in the signal: saturation, rescaled pixel values, or a change of light"
        found.append(Reason("bent line", "doubtful", text + ". Check the photon-transfer plot."))
    return found


def _range(pairs: Sequence[AlignedPair], detector: Detector, figures: Figures, repairs: Repairs) -> list[Reason]:
    found = []
    if repairs.joined:
        text = f"pixels above {repairs.join:.5g} counts ({repairs.joined:.1%}) use fewer of the converter's codes: the frame "
        text += "combines two converters (high dynamic range), or its values are companded. "
        few = repairs.joined <= MOST_JOINED
        text += (
            "These pixels were treated as clipped; the results and noise models apply to the darker pixels"
            if few
            else "No single gain fits both ranges"
        )
        found.append(
            Reason(
                "joined converters", "doubtful" if few else "bad", text + ". Record with a single converter setting."
            )
        )
    found += bent_response(detector.response)
    for pair in pairs:
        if pair.exposure_ratio is not None and not pair.one_setting:
            text = f"the fitted ratio of the exposures is {1 / pair.scaling.slope:.3g}, the given one {pair.exposure_ratio:.3g}. "
            text += "The given ratio was not used: it is wrong, or the exposures differ in gain or processing"
            found.append(Reason("exposure ratio", "doubtful", text + ". Check --exposure-ratio, or leave it out."))
            break
    shares = [full_share(pair) for pair in pairs]
    if max(shares) > 0.001:
        text = f"{max(shares):.1%} of the pixels are at full-well saturation, below the converter's upper limit"
        found.append(Reason("saturation", "doubtful", text + ". Use a shorter exposure."))
    return found


def bent_response(response: Response) -> list[Reason]:
    """Return the reason to report if the response is not linear."""
    if not response.bent:
        return []
    text = f"the response is not linear: the signal grows as light^{response.exponent:.3f} (± {response.error:.3f}), or the dark "
    text += "frames or the exposure ratio belong to another setting. The gain is the local one at the mean signal"
    return [Reason("nonlinear response", "doubtful", text + ". Use raw frames, and dark frames of the same setting.")]


def with_pattern(reasons: Sequence[Reason], pattern: Pattern, correlation: Correlation, gain: float) -> list[Reason]:
    """Add that the noise depends on the place, and leave out what follows from it.

    Classes of pixels with gains of their own have a period, and give both exposures the same fine detail. Resampling has a period
    too, but correlates neighbours.
    """
    if correlation.found and correlation.period:
        return list(reasons)
    found = uneven_field(pattern, gain)
    explained = ("periodic noise", "short contained") if found and pattern.factors else ()
    return [*found, *(one for one in reasons if one.name not in explained)]


def uneven_field(pattern: Pattern, gain: float) -> list[Reason]:
    """Return the reason to report if the noise at equal signal depends on the place."""
    if pattern.relative <= (MOST_UNEVEN_FIELD if pattern.name == "field" else BIAS):
        return []
    text = f"at equal signal the noise variance differs by {pattern.relative:.1%} rms (± {pattern.error:.1%}) "
    if pattern.name == "field":
        text += "across the field: the frames were divided by a flat field or corrected for shading, so no single gain applies"
        return [Reason("uneven field", "doubtful", text + ". Use uncorrected frames.")]
    gains = ", ".join(f"{gain * one:.4g}" for one in pattern.factors)
    text += f"between classes of pixels ({pattern.name}), whose gains are {gains} counts/e⁻: amplifiers or filters of their own"
    return [Reason("uneven gains", "doubtful", text + ". Calibrate each class alone.")]


def full_share(pair: AlignedPair) -> float:
    """Share of pixels in a peak at the upper end of the histogram that no clipping limit explains.

    The histogram of a scene falls off towards its brightest values. A full well followed by read noise adds a second mode there.
    """
    if np.isfinite(rails(pair.short)[1]):
        return 0.0
    values = pair.short[pair.mask]
    low, high = np.percentile(values, (50, 99.99))
    width = max(1.0, np.ceil((high - low) / BINS))  # whole counts avoid aliasing with the converter's steps
    counts, _ = np.histogram(values, low - 0.5 + width * np.arange(BINS + 1))
    smooth = np.convolve(counts, np.ones(3) / 3, mode="same")
    last = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    peak = BINS // 4 + int(np.argmax(smooth[BINS // 4 :]))
    valley = BINS // 8 + int(np.argmin(smooth[BINS // 8 : peak + 1]))
    second = peak > 0.6 * last and smooth[peak] > 3 * (smooth[valley] + np.sqrt(smooth[valley]) + 1)
    return float(counts[valley:].sum() / values.size) if second else 0.0
