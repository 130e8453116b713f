"""The figures that are reported: the posterior's, or what photon transfer and correlation leave of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.measure import Detector
from calibration.detector.posterior import Interval
from calibration.detector.repair import Repairs
from noiseflow.described import described

LARGEST_MISFIT = 1.3
"""χ² per degree of freedom above which the pixel values do not come from a Poisson-Gaussian detector."""

LARGEST_DISAGREEMENT = 0.02
"""Relative difference of the posterior's gain from that of the photon-transfer line, beyond three errors of the line, at which
the shape of the noise speaks against its variance: the goal for the gain."""

LARGEST_UNEVENNESS = 0.05
"""Relative deviation of the pixels' variances above which one gain and read noise do not describe them all: mixed so, the tails
of the noise exceed any single pixel's by the square, a quarter of a percent, which pulls an offset but hardly a gain."""

RESAMPLED_ERROR = 0.03
"""Relative standard error of a gain from which linear interpolation was taken out: the places between pixels that it happened to
take move its noise by this (frames resampled by 0.75 to 1.25: errors of −3 to +6 %)."""

NINETY = 1.645
"""Standard deviations either way of a 90 % interval."""


@described(gain="counts per electron", offset="counts", read_noise="electrons")
@dataclass(frozen=True)
class Figures:
    """Gain, offset and read noise as reported, with 90 % intervals.

    Attributes:
        gain: counts per electron, times the excess-noise factor of a detector that has one.
        offset: counts; None where the exposures do not determine it.
        read_noise: electrons rms; None where the exposures do not determine it.
        source: ``"posterior"``, or ``"photon transfer"`` where the noise is not Poisson-Gaussian: the line of variance against
            signal holds for any detector of independent events.
        factor: by which correlation between pixels, or resampling, had reduced the variance, taken out of the gain; 1: none.
    """

    gain: Interval
    offset: Interval | None
    read_noise: Interval | None
    source: str = "posterior"
    factor: float = 1.0


def figures_of(detector: Detector, correlation: Correlation, repairs: Repairs) -> Figures:
    """The figures to report.

    Args:
        detector: measured on repaired pairs.
        correlation: of the same pairs.
        repairs: what was modelled.
    """
    found = detector.posterior
    figures = Figures(_with_line(detector), found.offset, found.read_noise)
    if not poisson_gaussian(detector):
        figures = _by_line(detector)
    if correctable(correlation, repairs) and not detector.electrons:  # no filter leaves single electrons
        return _decorrelated(figures, correlation)
    return figures


def poisson_gaussian(detector: Detector) -> bool:
    """Whether the shape of the noise agrees with that of a Poisson-Gaussian detector, and its gain with photon transfer."""
    return detector.misfit <= LARGEST_MISFIT and not disagrees(detector) and detector.uneven <= LARGEST_UNEVENNESS


def disagrees(detector: Detector) -> bool:
    """Whether the posterior's gain departs from the photon-transfer line; where single electrons show, they are the gain."""
    if detector.electrons:
        return False
    line, gain = detector.line, detector.posterior.gain.median
    return bool(abs(gain - line.gain) > max(LARGEST_DISAGREEMENT * gain, 3 * line.gain_error))


def correctable(correlation: Correlation, repairs: Repairs) -> bool:
    """Whether the correlation is that of a short filter, and not of a scene that does not fit."""
    still = not repairs.refitted and repairs.changed < 0.5
    return correlation.found and correlation.local and still and correlation.factor > 3 * correlation.factor_error


def _with_line(detector: Detector) -> Interval:
    """The posterior's gain; where nothing but the noise tells the offset, with an interval that holds photon transfer's too.

    There the prior of read noise narrows the gain by what the noise's skewness says, to intervals that held the truth in 83 to
    86 % of simulated pairs. The line's own held it in 91 %, and knows no prior. Single electrons that show tell it to a
    thousandth.
    """
    gain, line = detector.posterior.gain, _normal(detector.line.gain, detector.line.gain_error)
    if detector.electrons or detector.offset is not None or any(one.common.any() for one in detector.levels):
        return gain
    return Interval(gain.median, min(gain.q05, line.q05), max(gain.q95, line.q95))


def _by_line(detector: Detector) -> Figures:
    """Gain by photon transfer; offset and read noise only from dark frames."""
    line = detector.line
    gain = _normal(line.gain, line.gain_error)
    if detector.offset is None:
        return Figures(gain, None, None, "photon transfer")
    read = detector.dark_deviation
    relative = float(np.hypot(line.gain_error / line.gain, 1e-3))
    noise = None if read is None else _normal(read / line.gain, read / line.gain * relative)
    return Figures(gain, _normal(*detector.offset), noise, "photon transfer")


def _decorrelated(figures: Figures, correlation: Correlation) -> Figures:
    """Variance before a filter that keeps the mean: the noise's spectral density at frequency 0, which is one per area of the
    frames as they were before they were resampled."""
    area = correlation.step**2
    factor, error = area * correlation.factor, area * correlation.factor_error
    gain, resampled = figures.gain, RESAMPLED_ERROR if area != 1 else 0.0
    middle = gain.median * factor
    width = (gain.q95 - gain.q05) / (2 * NINETY) / gain.median * correlation.inflation
    whole = middle * float(np.linalg.norm((width, error / factor, resampled)))
    read = figures.read_noise
    noise = (
        None if read is None else Interval(*(value / np.sqrt(factor) for value in (read.median, read.q05, read.q95)))
    )
    return Figures(_normal(middle, whole), figures.offset, noise, figures.source, factor)


def _normal(middle: float, error: float) -> Interval:
    return Interval(middle, middle - NINETY * error, middle + NINETY * error)
