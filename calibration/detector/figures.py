"""Reported gain, offset and read noise: from the posterior or from photon transfer, corrected for pixel correlation."""

from dataclasses import dataclass, replace

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.measure import Detector
from calibration.detector.posterior import NINETY, Interval
from calibration.detector.repair import Repairs
from calibration.tolerances import CLEAR, EXCESS, GAIN, LIKELY, MISFIT, MODELLED, UNEVEN
from noiseflow.checks import Effect
from noiseflow.described import described


@described(gain="counts per electron", offset="counts", read_noise="electrons")
@dataclass(frozen=True)
class Figures:
    """Gain, offset and read noise as reported, with 90 % intervals.

    Attributes:
        gain: counts per electron, times the excess-noise factor if the detector has one: the local gain at the mean signal. The
            interval includes that the exponent of the response may not be known.
        offset: counts; None if the exposures do not determine it.
        read_noise: electrons rms; None if the exposures do not determine it.
        source: ``"posterior"``, or ``"photon transfer"`` if the noise is not Poisson-Gaussian. Photon transfer is valid for any
            detector of independent events.
        linear: the same for a detector with a linear response.
        excess: excess-noise factor F²; None if unknown.
        factor: correction of the gain for the variance lost by pixel correlation or resampling; 1 if none.
    """

    gain: Interval
    offset: Interval | None
    read_noise: Interval | None
    source: str = "posterior"
    factor: float = 1.0
    linear: Interval | None = None
    excess: Interval | None = None


def figures_of(detector: Detector, correlation: Correlation, repairs: Repairs) -> Figures:
    """Select and correct the figures to report of a detector measured on repaired pairs, whose residuals show a correlation."""
    figures = replace(_of_linear(detector, correlation, repairs), excess=None if correlation.found else detector.excess)
    if detector.electrons:  # the distance of the peaks is the gain, whatever the response
        return replace(figures, linear=figures.gain)
    local = detector.response.local(figures.gain)
    read = figures.read_noise
    if read is not None:
        change = figures.gain.median / local.median
        low, high = (local.median / one for one in (local.q95, local.q05))
        kept = figures.gain.median / figures.gain.q95, figures.gain.median / max(figures.gain.q05, 1e-3 * local.median)
        read = Interval(change * read.median, change * read.q05 * low / kept[0], change * read.q95 * high / kept[1])
    return replace(figures, gain=local, linear=figures.gain, read_noise=read)


def _of_linear(detector: Detector, correlation: Correlation, repairs: Repairs) -> Figures:
    found = detector.posterior
    figures = Figures(_with_line(detector), found.offset, found.read_noise)
    if not poisson_gaussian(detector):
        figures = _by_line(detector)
    # a filter would have blurred single-electron peaks
    if correctable(correlation, repairs) and not detector.electrons:
        return _decorrelated(figures, correlation)
    return figures


def poisson_gaussian(detector: Detector) -> bool:
    """Whether the noise has the shape of a Poisson-Gaussian detector's, and its gain agrees with photon transfer."""
    found = disagreement(detector)
    agrees = abs(found.value) <= max(GAIN, LIKELY * found.error)
    skewed = detector.skew.value > max(least_skew(), CLEAR * detector.skew.error)
    return detector.misfit <= 1 + MISFIT and agrees and detector.uneven <= UNEVEN and not skewed


def least_skew(*_: object) -> float:
    """Third cumulant beyond that of Poisson noise, as a share of it, with the smallest excess-noise factor."""
    return 1 - 1 / EXCESS


def disagreement(detector: Detector) -> Effect:
    """Difference of the posterior's gain from photon transfer, of the gain; none if single-electron peaks determine it."""
    if detector.electrons:
        return Effect(0.0)
    line, gain = detector.line, detector.posterior.gain.median
    return Effect(1 - line.gain / gain, line.gain_error / gain)


def correctable(correlation: Correlation, repairs: Repairs) -> bool:
    """Whether the correlation is that of a short filter, and not caused by a misfit of the scene."""
    return correlation.filtered and not repairs.refitted and repairs.changed < 0.5


def _with_line(detector: Detector) -> Interval:
    """Return the posterior's gain; if only the noise determines the offset, the interval also covers that of photon transfer.

    In that case the read-noise prior narrows the interval of the gain through the skewness of the noise: it contained the true
    value in 83 to 86 % of simulated pairs. The interval of photon transfer uses no prior and contained it in 91 %.
    Single-electron peaks determine the gain to 0.1 % and need no correction.
    """
    gain, line = detector.posterior.gain, Interval.normal(detector.line.gain, detector.line.gain_error)
    if detector.electrons or detector.offset is not None or any(one.common.any() for one in detector.levels):
        return gain
    return gain.covering(line)


def _by_line(detector: Detector) -> Figures:
    """Return the gain from photon transfer, and offset and read noise from dark frames only."""
    line = detector.line
    gain = Interval.normal(line.gain, line.gain_error)
    if detector.offset is None:
        return Figures(gain, None, None, "photon transfer")
    dark, noise, relative = detector.dark, None, float(np.hypot(line.gain_error / line.gain, 1e-3))
    if dark and not (dark.clipped or dark.coarse):
        read = float(np.sqrt(max(dark.variance, 0.0))) / line.gain
        noise = Interval.normal(read, read * relative)
    return Figures(gain, Interval.normal(*detector.offset[:2]), noise, "photon transfer")


def _decorrelated(figures: Figures, correlation: Correlation) -> Figures:
    """Correct the variance for a mean-preserving filter, which preserves the noise's spectral density at frequency 0.

    The density refers to the pixel area of the frames before resampling. Intervals are wider, as fewer pixels are independent.
    """
    area = correlation.step**2
    factor, error = area * correlation.factor, area * correlation.factor_error
    gain = figures.gain.widened(wider := correlation.inflation)
    offset, read = (one and one.widened(wider) for one in (figures.offset, figures.read_noise))
    middle, resampled = figures.gain.median * factor, MODELLED if area != 1 else 0.0
    width = (gain.q95 - gain.q05) / (2 * NINETY) / gain.median
    whole = middle * float(np.linalg.norm((width, error / factor, resampled)))
    noise = None if read is None else replace(read, q05=max(read.q05, 0.0)).times(1 / np.sqrt(factor))
    return Figures(Interval.normal(middle, whole), offset, noise, figures.source, factor)
