"""Exponent of the detector's response to light, and what it leaves of the gain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.detector.posterior import Interval
from calibration.exposures.frames import Image
from calibration.tolerances import GAIN, LIKELY
from noiseflow.described import described
from noiseflow.statistics import uniform_variance, weighted_line

PRIOR = 0.125
"""Standard deviation of the exponent about 1 before anything is measured: nine of ten detectors have exponents of 0.8 to 1.2.
Cameras that fulfil EMVA 1288 stay within 0.02, photomultipliers and scintillators lose a tenth, and encoded images far more."""

WRONG_RATIO = 0.05
"""Share of exposures with a wrong ratio, or with another gain or processing for the long exposure."""

EXPONENTS = np.linspace(0.6, 1.5, 181)


@described(exponent="power of the light", error="power of the light")
@dataclass(frozen=True)
class Response:
    """Response of the detector, signal − offset ∝ light^exponent.

    Attributes:
        exponent: posterior mean; 1 if nothing but its prior is known.
        error: standard deviation of its posterior.
        excess: deviation from 1 in standard errors, from the likelihood of 1 relative to the largest. Hypotheses that suit the
            variances less, such as a long exposure of another setting, increase `error`, but not the likelihood of 1.
        known: whether exposures determine it, by dark frames or a known exposure ratio.
        low, middle, high: 5 %, 50 % and 95 % quantiles of the local gain at the mean signal over the gain of a linear response.
    """

    exponent: float
    error: float
    excess: float
    known: bool
    low: float
    middle: float
    high: float

    @property
    def bent(self) -> bool:
        """Whether the exponent differs from 1 significantly and by more than half of `GAIN`."""
        return self.known and self.excess > LIKELY and abs(self.exponent - 1) > GAIN / 2

    def local(self, gain: Interval) -> Interval:
        """Return the local gain at the mean signal from the gain of a linear response.

        The median changes only if the response is bent; the interval covers the exponents that are possible, also a linear one.
        """
        middle = self.middle if self.bent else 1.0
        low, high = min(self.low, middle), max(self.high, middle)
        below = np.hypot(np.log(gain.median / max(gain.q05, 1e-3 * gain.median)), np.log(middle / low))
        above = np.hypot(np.log(max(gain.q95, gain.median) / gain.median), np.log(high / middle))
        median = middle * gain.median
        found = Interval(median, float(median * np.exp(-below)), float(median * np.exp(above)))
        return found.covering(gain) if self.low <= 1 <= self.high else found


LINEAR = Response(1.0, 0.0, 0.0, True, 1.0, 1.0, 1.0)
"""A response known to be linear."""


@dataclass(frozen=True)
class Long:
    """Lines of variance against signal of long exposures, in their own units, and the offset of all, with its error.

    Attributes:
        signal: (P, N) counts, typical of the pixels.
        projection: (P, 2, N) level and slope of the lines, as averages of the variances at `signal`.
        variance, error: (P, 2) level and slope, and their standard errors, counts² and counts.
    """

    offset: tuple[float, float]
    signal: Image
    projection: Image
    variance: Image
    error: Image


def response_of(
    signal: Image,
    variance: Image,
    error: Image,
    *,
    offset: tuple[float, ...] | None = None,
    ratio: tuple[float, float] | None = None,
    long: Long | None = None,
    early: bool = False,
) -> Response:
    """Fit the exponent to the variances at several signals.

    With electrons n and a signal m = c·nᵞ above the offset, the local gain is g = γ·m/n and the shot-noise variance g²·n = γ·g·m,
    which grows as m^(2 − 1/γ). Read noise is constant, or varies as m^(2 − 2/γ) if it precedes the response. An unknown offset
    lies between the zero of a line and the darkest signal, or as far below that zero.

    Args:
        signal: (L,) counts; dark frames may be among them.
        variance, error: (L,) variances and their standard errors, counts².
        offset: signal without light and its standard error, counts; None if unknown.
        ratio: exponent that the scaling of an exposure pair implies, and its standard error; None if unknown.
        long: brighter points of the same curve, if the long exposures were recorded at the same setting.
        early: whether read noise may precede the response in the curve with `long`; by default only if the response is then bent.
    """
    prior = believed = np.exp(-0.5 * ((EXPONENTS - 1) / PRIOR) ** 2)
    if ratio is not None:
        near = np.exp(-0.5 * ((EXPONENTS - ratio[0]) / ratio[1]) ** 2)
        prior = prior * (near / max(near.sum(), np.finfo(float).tiny) + WRONG_RATIO / len(EXPONENTS))
    points, dark = (signal, variance, error), offset is not None
    weight, change, linear, _ = _hypotheses(prior, points, offset, dark)
    if long is not None:
        near, changes, other, odds = _hypotheses(prior, points, offset or long.offset, dark or not early, long)
        changes *= other / linear if linear else 1.0  # the gain was measured without that offset
        odds *= (1 - WRONG_RATIO) / WRONG_RATIO
        weight = np.concatenate([weight / (1 + odds), near * odds / (1 + odds)], axis=1)
        change = np.concatenate([change, changes], axis=1)
    weight = weight / weight.sum()
    by_exponent = weight.sum(axis=1)
    exponent = float(by_exponent @ EXPONENTS)
    spread = float(np.sqrt(by_exponent @ (EXPONENTS - exponent) ** 2 + uniform_variance(EXPONENTS[1] - EXPONENTS[0])))
    factor = Interval.of(change, weight)
    excess = abs(exponent - 1) / spread
    if dark or ratio is not None or long is not None:  # a curve alone has other reasons to bend
        likelihood = np.maximum(by_exponent / believed, np.finfo(float).tiny)
        excess = float(np.sqrt(2 * np.log(likelihood.max() / likelihood[np.argmin(np.abs(EXPONENTS - 1))])))
    known = (spread < PRIOR / 2 or excess > LIKELY) and (ratio is not None or weight.shape[1] > 1)
    found = Response(exponent, spread, excess, known, factor.q05, factor.median, factor.q95)
    if ratio is not None and found.bent:  # or linear, with a wrong ratio
        found = replace(found, low=min(found.low, 1.0), high=max(found.high, 1.0))
    # noise before a linear response is that after it, and would leave the gain of few electrons open
    again = not (early or dark or long is None)
    wider = response_of(*points, offset=offset, ratio=ratio, long=long, early=True) if again else found
    return wider if wider.bent else found


def _hypotheses(
    prior: Image,
    points: Sequence[Image],
    offset: tuple[float, ...] | None,
    dark: bool,
    long: Long | None = None,
    *,
    settings: float = 4.0,
) -> tuple[Image, Image, float, float]:
    """Return the weights of exponents and hypotheses, (E, H) with sum 1, the local gain over that of a linear response, and that.

    The linear response is that of the points without `long`; its gain is 0 if they are too few. The last value is the
    likelihood of the long exposures under the same setting over that under others, whose logarithms of the variance have the
    range of `settings`; 0 without them.
    """
    curves = _curves(points, offset, dark)
    if curves is None:
        return prior[:, None] / prior.sum(), 1 / (2 * EXPONENTS - 1)[:, None], 0.0, 0.0
    chi_squared, gains = curves
    least, odds = float(chi_squared.min()), 0.0
    scale = max(least / max(len(points[0]) - 3, 1), 1.0)

    def weighed(chi_squared: Image) -> Image:
        likelihood = np.maximum(np.exp(-0.5 * (chi_squared - least) / scale), np.finfo(float).tiny)
        # the number of offsets that suit an exponent is no evidence for it
        return np.asarray(prior[:, None] * likelihood * (likelihood.max(axis=1) / likelihood.sum(axis=1))[:, None])

    weight = weighed(chi_squared)
    straight = int(np.argmin(np.abs(EXPONENTS - 1)))
    linear = float(np.average(gains[straight], weights=weight[straight] + np.finfo(float).tiny))
    change = gains / linear
    if long is not None:
        more = map(np.append, points, (long.signal, long.variance, long.error))
        whole, gains = _curves(list(more), offset, dark, onto=long.projection) or curves
        alone, weight, change = weight, weighed(whole), change * gains / curves[1]
        density = settings / (np.sqrt(2 * np.pi) * long.error[:, 0] / long.variance[:, 0])
        odds = float(weight.sum() / alone.sum() * np.prod(density))
    return weight / weight.sum(), change, linear, odds


def _curves(
    points: Sequence[Image],
    offset: tuple[float, ...] | None,
    dark: bool,
    *,
    onto: Image | None = None,
    few: int = 8,
    unknown: tuple[float, float, int] = (0.05, 2.0, 14),
) -> tuple[Image, Image] | None:
    """Return χ² and the local gain at the mean signal, (exponent, hypothesis); None if the curve has too few points.

    The last variances are averages, by `onto`, of those at the last signals. Without the offset, half of the `few` points
    determine four parameters, and as many test them; `unknown` ones are at distances from the darkest signal, over that of the
    zero of the variance line, from the first to the second and of that number.
    """
    signal, variance, error = points
    if offset is not None:
        # a Gauss-Hermite rule of three points
        offsets = offset[0] + offset[1] * np.sqrt(3) * np.array([0, -1, 1])
        share = np.array([2 / 3, 1 / 6, 1 / 6])
    else:
        line, darkest = weighted_line(signal, variance, 1 / error**2), float(signal.min())
        if len(signal) < few or not line.slope > 0:
            return None
        offsets = darkest - max(darkest + line.intercept / line.slope, 0.0) * np.linspace(*unknown)
        share = np.full(len(offsets), 1 / len(offsets))
    light = signal - offsets[:, None]
    lit = light > 0
    if lit.sum(axis=1).min() < 2 or len(signal) < 3:
        return None
    single = len(signal) - (0 if onto is None else onto[:, 0].size)
    pixels = (variance[:single] / error[:single]) ** 2  # in proportion; levels of a scene have different numbers
    reference = np.average(light[:, :single], axis=1, weights=lit[:, :single] * pixels)
    relative = np.maximum(light / reference[:, None], 1e-9)
    powers = [relative ** power[:, None, None] for power in (2 - 1 / EXPONENTS, 2 - 2 / EXPONENTS)]
    shapes, reads = np.where(lit, powers[0], 0.0), np.ones_like(powers[0])
    if not dark:  # in darkness, which dark frames show, noise before the response has no such power
        shapes = np.concatenate([shapes, shapes], axis=1)
        reads = np.concatenate([reads, powers[1]], axis=1)
        share, reference = np.tile(share, 2), np.tile(reference, 2)
    if onto is not None:
        form = (*shapes.shape[:-1], len(onto), -1)
        lines = (np.einsum("...pn,pkn->...pk", one[..., single:].reshape(form), onto) for one in (shapes, reads))
        singles = shapes[..., :single], reads[..., :single]
        shapes, reads = (
            np.append(one, two.reshape(*form[:-2], -1), axis=-1) for one, two in zip(singles, lines, strict=True)
        )
    chi_squared, shots, rest = _shot_and_read(shapes, reads, variance, error)
    if not dark:  # a response shows only above the noise before it
        chi_squared[:, len(offsets) :][rest[:, len(offsets) :] > shots[:, len(offsets) :]] = np.inf
    gains = np.maximum(shots, np.finfo(float).tiny) / (EXPONENTS[:, None] * reference)
    return chi_squared - 2 * np.log(share), gains


def _shot_and_read(shape: Image, read: Image, variance: Image, error: Image) -> tuple[Image, Image, Image]:
    """Fit variance = a·shape + b·read with b ≥ 0 along the last axis; return χ², a and b."""
    weight = 1 / np.maximum(error, 1e-3 * np.abs(variance) + np.finfo(float).tiny) ** 2
    ss, sr, rr = ((weight * one).sum(-1) for one in (shape * shape, shape * read, read * read))
    sv, rv = ((weight * variance * one).sum(-1) for one in (shape, read))
    determinant = np.maximum(ss * rr - sr**2, 1e-12 * ss * rr)
    b = np.maximum((ss * rv - sr * sv) / determinant, 0.0)
    a = (sv - b * sr) / ss
    residual = variance - a[..., None] * shape - b[..., None] * read
    return np.asarray((weight * residual**2).sum(-1)), a, b
