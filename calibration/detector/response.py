"""Exponent of the detector's response to light, and what it leaves of the gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.detector.posterior import Interval
from calibration.exposures.frames import Image
from noiseflow.described import described

PRIOR = 0.09
"""Standard deviation of the exponent about 1 before anything is measured: nine of ten detectors have exponents of 0.85 to 1.15.
Cameras that fulfil EMVA 1288 stay within 0.02, photomultipliers and scintillators lose a tenth, and encoded images far more."""

RATIO_ERROR = 0.01
"""Relative error of a given exposure ratio: stability of lamp and shutter."""

WRONG_RATIO = 0.02
"""Share of given exposure ratios that are wrong."""

CLEAR = 3.0
"""Standard errors from which an exponent is reported and modelled."""

LEAST_CURVATURE = 0.01
"""Least deviation of the exponent that is reported; it changes the gain by 2 %, the target accuracy."""

EXPONENTS = np.linspace(0.6, 1.5, 361)


@described(exponent="power of the light", error="power of the light")
@dataclass(frozen=True)
class Response:
    """Response of the detector, signal − offset ∝ light^exponent.

    Attributes:
        exponent: posterior mean; 1 if nothing but its prior is known.
        error: standard deviation of its posterior.
        known: whether exposures determine it, by dark frames or a known exposure ratio.
        low, middle, high: 5 %, 50 % and 95 % quantiles of the local gain at the mean signal over the gain of a linear response.
    """

    exponent: float
    error: float
    known: bool
    low: float
    middle: float
    high: float

    @property
    def bent(self) -> bool:
        """Whether the exponent differs from 1 significantly and by more than `LEAST_CURVATURE`."""
        return self.known and abs(self.exponent - 1) > max(CLEAR * self.error, LEAST_CURVATURE)

    def local(self, gain: Interval) -> Interval:
        """Return the local gain at the mean signal from the gain of a linear response.

        The median changes only if the response is bent; the interval covers the exponents that are possible.
        """
        middle = self.middle if self.bent else 1.0
        low, high = min(self.low, middle), max(self.high, middle)
        below = np.hypot(np.log(gain.median / max(gain.q05, 1e-3 * gain.median)), np.log(middle / low))
        above = np.hypot(np.log(max(gain.q95, gain.median) / gain.median), np.log(high / middle))
        median = middle * gain.median
        return Interval(median, float(median * np.exp(-below)), float(median * np.exp(above)))


LINEAR = Response(1.0, 0.0, True, 1.0, 1.0, 1.0)
"""A response known to be linear."""


def response_of(
    signal: Image,
    variance: Image,
    error: Image,
    *,
    offset: tuple[float, float] | None = None,
    ratio: tuple[float, float] | None = None,
) -> Response:
    """Fit the exponent to the variances at several signals.

    With electrons n and a signal m = c·nᵞ above the offset, the local gain is g = γ·m/n and the shot-noise variance g²·n = γ·g·m,
    which grows as m^(2 − 1/γ). Variances near the mean signal have the slope g·(2γ − 1). Without the offset, the curve determines
    no exponent: read noise that is shaped by the response hides it, so that the prior remains.

    Args:
        signal: (L,) counts; dark frames may be among them.
        variance: (L,) counts².
        error: (L,) standard errors of `variance`, counts².
        offset: signal without light and its standard error, counts; None if unknown.
        ratio: exponent that the scaling of an exposure pair implies, and its standard error; None if unknown.
    """
    weight = np.exp(-0.5 * ((EXPONENTS - 1) / PRIOR) ** 2)
    change = 1 / (2 * EXPONENTS - 1)
    if ratio is not None:
        near = np.exp(-0.5 * ((EXPONENTS - ratio[0]) / ratio[1]) ** 2)
        weight = weight * (near / max(near.sum(), np.finfo(float).tiny) + WRONG_RATIO / len(EXPONENTS))
    # the nodes and weights of a Gauss-Hermite rule of three points
    shifts = () if offset is None else ((0.0, 2 / 3), (-np.sqrt(3), 1 / 6), (np.sqrt(3), 1 / 6))
    found = [(_curve(signal - offset[0] - by * offset[1], variance, error), share) for by, share in shifts if offset]
    curves = [(one, share) for one, share in found if one is not None]
    if curves:
        chi_squared = -2 * np.logaddexp.reduce([np.log(share) - 0.5 * one[0] for one, share in curves])
        gains = curves[0][0][1]
        scale = max(float(chi_squared.min()) / max(len(signal) - 3, 1), 1.0)
        weight = weight * np.exp(-0.5 * (chi_squared - chi_squared.min()) / scale)
        change = gains / float(np.interp(1.0, EXPONENTS, gains))
    weight = weight / weight.sum()
    exponent = float(weight @ EXPONENTS)
    spread = float(np.sqrt(weight @ (EXPONENTS - exponent) ** 2 + (EXPONENTS[1] - EXPONENTS[0]) ** 2 / 12))
    low, middle, high = (float(one) for one in _quantiles(change, weight, (0.05, 0.5, 0.95)))
    return Response(exponent, spread, bool(curves) or ratio is not None, low, middle, high)


def _curve(light: Image, variance: Image, error: Image) -> tuple[Image, Image] | None:
    """Return χ² and the local gain at the mean signal for each of `EXPONENTS`; None if the curve has too few points."""
    lit = light > 0
    if lit.sum() < 2 or len(light) < 3:
        return None
    reference = float(light[lit].mean())
    share = np.maximum(light, 0.0) / reference
    found = np.array([_shot_and_read(share ** (2 - 1 / power), variance, error) for power in EXPONENTS])
    return found[:, 0], np.maximum(found[:, 1], np.finfo(float).tiny) / (EXPONENTS * reference)


def _shot_and_read(shape: Image, variance: Image, error: Image) -> tuple[float, float]:
    """Fit variance = shot·shape + read with read ≥ 0; return χ² and shot."""
    weight = 1 / np.maximum(error, 1e-3 * np.abs(variance).max()) ** 2
    design = np.stack([shape, np.ones_like(shape)])
    gram, moment = design * weight @ design.T, design * weight @ variance
    shot, read = np.linalg.solve(gram + 1e-12 * np.diag(np.diag(gram)), moment)
    if read < 0:
        shot, read = moment[0] / gram[0, 0], 0.0
    return float(np.sum(weight * (variance - shot * shape - read) ** 2)), float(shot)


def _quantiles(values: Image, weight: Image, shares: tuple[float, ...]) -> NDArray[np.float64]:
    order = np.argsort(values)
    below = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.interp(shares, below, values[order])
