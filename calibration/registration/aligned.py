"""Aligned pairs: observation, signal and residual of each pixel, from an exposure pair or a burst."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import ExposurePair, Image, blurred_step, rails, rounding_step
from calibration.exposures.masks import Mask, MaskCounts, clear_of_rails, counted, mended, outliers_of, saturated
from calibration.exposures.scaling import (
    BLUR,
    Scaling,
    VarianceLine,
    alike_apart,
    correlated,
    dilated,
    eroded,
    finest_band,
    fit_scaling,
    mean_and_error,
    own_variance,
    ring_mean,
    smoothed,
    spread_by_level,
)
from calibration.registration.align import Registration, register
from calibration.tolerances import CLEAR, LARGEST_RATIO_ERROR, LIKELY, MODELLED, STANDS_OUT
from noiseflow.described import described

MINIMUM_PIXELS = 500
"""Fewest pixels with which noise models can be distinguished."""

LARGEST_SLOPE = 0.5
"""Largest slope of the scaling for which `plain_ratio` is tested; above it the noise of the signal is too large a share."""


@dataclass(frozen=True)
class Residual:
    """Standardised residual of a pair's short exposure.

    Attributes:
        z: (..., y, x) residuals of one or several frames over the standard deviation at their level, clipped at `CLEAR`; 0
            outside the mask.
        mask: (y, x) valid pixels.
        share: share of the residual variance due to the noise of the signal, and to the gains of its pixels if they were removed.
        spread: (y, x) standard deviation at the level, counts.
        signal: (y, x) counts; None for frames without a scene.
        expected: (y, x) squares expected from each pixel's own signal, which the pixels of a mosaic do not share; None if all are
            equal.
        level: (y, x) signal of the neighbours, whose noise is independent of that of the pixel, counts; None without a scene.
    """

    z: Image
    mask: Mask
    share: float
    spread: Image
    signal: Image | None = None
    expected: Image | None = None
    level: Image | None = None


@described(short="counts", long="as recorded", signal="counts")
@dataclass(frozen=True)
class AlignedPair:
    """An unmodified short exposure and the signal of each of its pixels, estimated from the registered long exposure.

    Attributes:
        short: (y, x) counts.
        long: (y, x) as recorded.
        signal: (y, x) long exposure, warped and scaled to the short one, counts.
        mask: (y, x) valid pixels.
        registration: transform of the long exposure.
        scaling: scaling of the long exposure.
        total_variance: variance of short − signal, as a line in the signal.
        signal_variance: the part of it due to the noise of the signal estimate.
        counts: numbers of excluded pixels.
        exposure_ratio: given exposure ratio; None if unknown.
        frames: number of frames in the burst whose mean is the signal; 1 for an exposure pair.
        pattern: variance of the error of a pattern subtracted from both exposures, counts², and over that of read noise.
        gains: relative deviation of the pixels' gains, its removed share of a residual's variance, and its error, of the rest.
        by_gains: what was removed, as `Scale.gains`.
        hidden: share of the variance by outliers too weak to be excluded, and its error, as `outliers_of`.
        kernel: filter of the warped long exposure that best predicts the short one; None if none was fitted.
        white: (y, x) difference of white noise of unit variance from the mean of such frames, warped as those of the burst; None
            if nothing was warped.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> calibration.align_burst(calibration.Burst(frames))[0][0].observation.shape
        (64, 64)
    """

    short: Image
    long: Image
    signal: Image
    mask: Mask
    registration: Registration
    scaling: Scaling
    total_variance: VarianceLine
    signal_variance: VarianceLine
    counts: MaskCounts
    exposure_ratio: float | None = None
    frames: int = 1
    pattern: tuple[float, ...] = ()
    gains: tuple[float, ...] = ()
    by_gains: tuple[float, ...] = ()
    hidden: tuple[float, ...] = ()
    kernel: Image | None = None
    white: Image | None = None

    @property
    def observation(self) -> Image:
        """(y, x) short exposure, with its deviation from the signal scaled to the noise of the short exposure alone."""
        return self.signal + np.sqrt(1 - self.share(self.signal)) * (self.short - self.signal)

    @cached_property
    def level(self) -> Image:
        """(y, x) signal of the neighbours, whose noise is independent of that of the pixel, counts."""
        return ring_mean(self.signal, self.mask, inner=1, blur=2.0)

    @cached_property
    def residual(self) -> Residual:
        """Standardised residual of the short exposure from its signal."""
        return _residual_of(self)

    @property
    def step(self) -> float:
        """Rounding step of the signals, counts; 0 of means of other frames."""
        return self.scaling.slope * (rounding_step(self.long) or blurred_step(self.long)) if self.frames == 1 else 0.0

    @property
    def one_setting(self) -> bool:
        """Whether both exposures were recorded at one detector setting: the fitted ratio agrees with the given one."""
        ratio = self.scaling.slope * (self.exposure_ratio or 0.0)
        return bool(ratio > 0 and abs(np.log(ratio)) < LARGEST_RATIO_ERROR)

    @cached_property
    def kept(self) -> float:
        """Fraction of white-noise variance that interpolation and filtering of the long exposure preserve."""
        if self.frames > 1:
            return 1.0 if self.white is None else (self.frames - 1) * float(np.var(self.white) - 1)
        return float(np.var(self.noise[1][self.mask]))

    @property
    def noise(self) -> tuple[Image, Image]:
        """White noise of unit variance, and what interpolation and filtering of the long exposure make of it, (y, x) each."""
        white, warped = self.registration.noise(self.long.shape)
        return white, warped if self.kernel is None else correlated(warped, self.kernel)

    @cached_property
    def plain_ratio(self) -> float | None:
        """Exposure ratio implied by the scaling if the measured shot noise of the signal agrees with it, else None. Noise of the
        signal lowers the slope of the total variance, by 10 % in a dark scene; with the neighbours as instrument it is right,
        but too high where a sharp scene is misfitted: the truth lies between."""
        own, total, slope = self.signal_variance, self.total_variance, self.scaling.slope
        if self.frames > 1 or not own.rate_error > 0 or not 0 < slope < LARGEST_SLOPE:
            return None
        level, signal, short = (one[self.mask] for one in (self.level, self.signal, self.short))
        apart = (weight := 1 / total.bounded(level) ** 2) * (level - np.average(level, weights=weight))
        modelled = MODELLED * own.rate if self.registration.interpolates(self.long.shape) else 0.0
        share, error = self.kept * slope / (1 + self.kept * slope), LIKELY * float(np.hypot(own.rate_error, modelled))
        low, high = sorted((share * total.rate, share * float(apart @ (short - signal) ** 2 / (apart @ signal))))
        return 1 / slope if low - error < own.rate < high + error and error < low else None

    def share(self, signal: Image) -> Image:
        """Fraction of the residual variance at a signal that is due to the noise of its estimate, limited to [0, 0.9]."""
        own, whole = np.maximum(self.signal_variance(signal) + sum(self.pattern[:1]), 0.0), self.total_variance(signal)
        return np.asarray(np.divide(own, whole, out=np.where(own > 0, 1.0, 0.0), where=whole > own).clip(max=0.9))


def _residual_of(pair: AlignedPair, *, little: float = 0.1) -> Residual:
    part, kept = sum(pair.gains[1:2]), pair.kept  # gains of pixels deviate in both exposures
    share = (1 - part) * float(pair.share(pair.signal[pair.mask]).mean()) + part * kept / (1 + kept)
    # as little as the noise allows: at the same local average, a peak in the dark part of a crystal lattice is noisier than a
    # valley in the bright part
    blur = BLUR / 2 if share < little else BLUR
    difference, level = (pair.short - pair.signal)[pair.mask], smooth_signal(pair, blur=blur)[pair.mask]
    spread = np.ones(pair.mask.shape)
    spread[pair.mask] = np.interp(level, *spread_by_level(level, difference, step=rounding_step(pair.short)))
    z = np.zeros(pair.mask.shape)
    cut = np.clip(difference / spread[pair.mask], -CLEAR, CLEAR)
    z[pair.mask] = cut - cut.mean()  # the median of skewed noise differs from its mean, and would add a correlation
    scale = float(np.sqrt(np.mean(z[pair.mask] ** 2)))
    expected = pair.total_variance(pair.signal) / spread**2
    z = z / max(scale, np.finfo(float).tiny)
    return Residual(z, pair.mask, share, spread * scale, pair.signal, expected, pair.level)


def smooth_signal(pair: AlignedPair, *, blur: float = BLUR) -> Image:
    """Return the (y, x) signal smoothed with a Gaussian of `blur` pixels within the mask, counts."""
    weight = smoothed(pair.mask.astype(float), blur)
    inside = smoothed(np.where(pair.mask, pair.signal, 0.0), blur)
    middle = float(pair.signal[pair.mask].mean())
    return np.asarray(np.divide(inside, weight, out=np.full(inside.shape, middle), where=weight > 0.05))


def align_pair(pair: ExposurePair, registration: Registration | None = None) -> AlignedPair:
    """Register a pair unless its transform is known, and warp and scale the long exposure to the short one.

    Raises:
        ValueError: the frames cannot be registered or scaled, too few pixels remain, the long exposure is the noisier one, or it
            is a copy of the short one.

    Example:
        >>> import calibration, noiseflow, pathlib
        >>> folder = pathlib.Path(noiseflow.__file__).parent / "data" / "exposures_miro"
        >>> pairs = calibration.read_pairs([folder / "channel1_050ms.tif"], [folder / "channel1_long.tif"])
        >>> aligned = calibration.align_pair(pairs[0])
        >>> aligned.registration.motion, bool(aligned.mask.mean() > 0.9)
        ('translation', True)
    """
    (short, recorded), hot, dead = mended(pair.short, pair.long)  # hot pixels would outweigh the scene
    if registration is None:
        # clipped where the long exposure saturates: edges visible in only one frame would bias the registration
        most = np.quantile(short, 1 - share) if (share := float(np.mean(saturated(pair.long)))) else np.inf
        registration = register(short.clip(max=most), recorded, names=(pair.short_name, pair.long_name), still=True)
    long, covered = registration.warp(recorded)
    bad = saturated(pair.long)
    _require_pixels(~bad, pair)
    bad |= ~clear_of_rails(pair.long, ring_mean(pair.long, ~bad), ~bad)  # interpolated values go beyond limits
    # a bad pixel affects all pixels within reach of the interpolation
    reached = np.abs(registration.warp(bad.astype(float))[0]) + np.abs(registration.warp((hot | dead) / 10)[0])
    trusted = covered & ~(hot | dead) & (reached < 0.01)  # a median is off by a tenth of what a hot pixel is, or less
    _require_pixels(trusted, pair)
    level = ring_mean(long, trusted)
    if 1 - np.corrcoef(pair.short[trusted], long[trusted])[0, 1] ** 2 < 1e-9:  # only a scale and an offset differ
        raise ValueError(f"{pair.short_name} is a copy of {pair.long_name}; give two separate exposures of one scene")
    scaling = fit_scaling(pair.short, long, trusted)
    signal, near = (scaling.slope * one + scaling.intercept for one in (long, level))
    free = trusted & clear_of_rails(pair.short, near, trusted, deviations=3.0)
    step = rounding_step(pair.short) or blurred_step(pair.short)
    photons = counted(pair.short[trusted], signal[trusted], near[trusted], step=step)
    if photons is None and MINIMUM_PIXELS <= free.sum() < trusted.sum():
        scaling = fit_scaling(pair.short, long, free)
    signal, level = (scaling.slope * one + scaling.intercept for one in (long, level))
    beyond, hidden = outliers_of(pair.short - signal, level, trusted, pair.long, step=rounding_step(pair.short))
    found = dilated(beyond, 1) & trusted  # the finest band reaches one pixel
    trusted &= ~found
    railed = signal > rails(pair.short)[1] - 4 * np.std((pair.short - signal)[trusted])
    mask = trusted & ~railed
    _require_pixels(mask, pair)
    total = VarianceLine.fitted(signal[mask], ((pair.short - signal) ** 2)[mask])
    lost = covered & ~trusted & ~hot & ~dead & ~found
    lost_by = (~covered, (railed & trusted) | lost, hot, dead, np.zeros_like(hot), beyond)
    counts = MaskCounts(*(int(one.sum()) for one in lost_by))
    frames = pair.short, recorded, signal, mask
    own = own_variance(frames, scaling.slope, registration.warp, registration.noise(long.shape)[1])
    aligned = AlignedPair(*frames, registration, scaling, total, own, counts, pair.exposure_ratio, hidden=hidden)
    aligned = _without_gains(aligned) if registration.interpolates(long.shape) else aligned
    share = float(aligned.signal_variance(signal[mask]).mean()) / float(aligned.total_variance(signal[mask]).mean())
    if share > 0.5:  # the exposures are probably swapped
        raise ValueError(
            f"{pair.long_name} is noisier than {pair.short_name} ({share:.0%} of their difference is its noise); "
            "exchange the two, or give equal exposures as a burst"
        )
    return aligned


def _without_gains(pair: AlignedPair) -> AlignedPair:
    """Return the pair without the variance of the pixels' gains, which a scene that moved over them adds to the residual.

    At one place of the detector, residual and long exposure share the gain of the pixel, in proportion to the light, and after a
    small shift a known part of the noise: the covariance of their finest bands shows the gains. Reduced counts stay rounded.
    """
    scaling, mask, apart, warp = pair.scaling, pair.mask, alike_apart(pair.long), pair.registration.warp
    white, warped = pair.registration.noise(mask.shape)
    residual, long = pair.short - pair.signal, scaling.slope * pair.long + scaling.intercept
    offset = min(scaling.common_offset()[0], float(pair.level[mask].min()))
    whole = eroded(mask, apart) & (np.abs(residual) < STANDS_OUT * np.sqrt(pair.total_variance.bounded(pair.signal)))
    *bands, first, second = (finest_band(one, step=apart) for one in (residual, long, white, warped))
    alike = float(np.mean((first * second)[whole]))
    light = np.prod([np.maximum(ring_mean(one, mask) - offset, 0.0) for one in (pair.signal, long)], axis=0)
    scatter = np.prod([ring_mean(band**2, whole, inner=2, blur=2.0) for band in bands], axis=0)
    weight = np.where(whole, light / (scatter + np.median(scatter[whole])), 0.0)
    total, gains, own = np.sum(weight * light), 0.0, pair.signal_variance
    for _ in range(3):  # the variance of the signal is at first that of noise and gains together
        shared = np.prod(bands, axis=0) + alike * (own(long) / pair.kept + gains * light)
        gains = float(np.sum(weight * shared) / total)
        error = mean_and_error(weight * (shared - gains * light), whole)[1] * whole.sum() / total
        if not gains > CLEAR * error:
            return pair
        square = gains * np.maximum(pair.signal - offset, 0.0) ** 2
        own = own_variance((pair.short, pair.long, pair.signal, mask), scaling.slope, warp, warped, (square, alike))
    square *= (moved := float(np.var((white - warped)[mask])))
    line = VarianceLine.fitted(pair.signal[mask], (residual**2 - square)[mask])
    rest, unsure = line.bounded(pair.signal), np.hypot(MODELLED, error / gains)
    part = square / (square + rest)
    short, step = pair.signal + np.sqrt(1 - part) * residual, rounding_step(pair.short)
    short = np.where(mask, step * np.round(short / step) if step else short, pair.short)
    left = float(unsure * square[mask].mean() / rest[mask].mean())
    found = float(np.sqrt(gains)), float(part[mask].mean()), left
    by_gains = offset, gains * moved, float(unsure)
    return replace(pair, short=short, total_variance=line, signal_variance=own, gains=found, by_gains=by_gains)


def block_split(blocks: NDArray[np.int64], generator: np.random.Generator, *, fraction: float = 0.5) -> Mask:
    """Return a (y, x) mask of held-out `blocks`, so that correlated neighbours do not leak from the fit to the evaluation."""
    number = int(blocks.max()) + 1
    return np.isin(blocks, generator.permutation(number)[: max(1, round(fraction * number))])


def _require_pixels(mask: Mask, pair: ExposurePair) -> None:
    if (number := int(mask.sum())) < MINIMUM_PIXELS:
        raise ValueError(f"only {number} pixels of {pair.short_name} can be used; give more overlap or less saturation")
