"""The complete calibration in one call: align, measure the detector, fit and evaluate the noise models."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from torch import nn

import noiseflow
from calibration.detector.correlation import Correlation, correlation_of
from calibration.detector.figures import Figures, figures_of
from calibration.detector.levels import NotMeasurable
from calibration.detector.measure import Detector, measure_detector
from calibration.detector.models import SIMPLE, ModelScore, Pixels, collect_pixels, fit_models
from calibration.detector.repair import Repairs, repaired
from calibration.exposures.frames import Burst, ExposurePair, Image, rails
from calibration.exposures.masks import Mask, defects
from calibration.exposures.processing import below_joins
from calibration.exposures.scaling import VarianceLine
from calibration.registration.aligned import AlignedPair, align_pair
from calibration.registration.bursts import BurstReport, align_burst
from calibration.tolerances import CLIPPED
from calibration.verdict import CalibrationCase, judge, refusal
from noiseflow.checks import Verdict
from noiseflow.described import described
from noiseflow.progress import Progress


@described()
@dataclass(frozen=True)
class Findings:
    """Results of a calibration.

    Attributes:
        pairs: aligned pairs, or the frames of a burst.
        pixels: pixels used to fit and evaluate the models.
        scores: scores of the models.
        detector: the measured detector; None if the gain cannot be measured.
        no_detector: the reason, if `detector` is None.
        burst: drift and dose along a burst; None for pairs.
        figures: reported gain, offset and read noise; None if the gain cannot be measured.
        verdict: their reliability.
        correlation: correlation of the residuals of neighbouring pixels.
        repairs: violated assumptions that were modelled before the measurement.
        pattern: (y, x) fixed pattern of the dark frames that was subtracted, counts, mean 0 but for hot pixels; None if none was.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> round(calibration.calibrate_exposures(calibration.Burst(frames), kinds=["gaussian"]).figures.gain.median, 1)
        1.0
    """

    pairs: Sequence[AlignedPair]
    pixels: Pixels | None = None
    scores: Sequence[ModelScore] = ()
    detector: Detector | None = None
    no_detector: str = ""
    burst: BurstReport | None = None
    figures: Figures | None = None
    verdict: Verdict = field(default_factory=lambda: Verdict("bad", ()))
    correlation: Correlation | None = None
    repairs: Repairs = field(default_factory=Repairs)
    pattern: Image | None = None


def calibrate_exposures(
    exposures: Sequence[ExposurePair] | Burst,
    *,
    dark: Burst | None = None,
    flat: Burst | None = None,
    offset: float | None = None,
    kinds: Sequence[str] | str | None = None,
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> Findings:
    """Align exposures, measure the detector, and fit and evaluate the noise models.

    Args:
        exposures: exposure pairs, or one burst.
        dark: frames taken without light.
        flat: frames of uniform illumination.
        offset: known offset, counts, if there are no dark frames; 0 if they were subtracted.
        kinds: names of the noise models to fit; see `fit_models`. By default without flexible ones if the verdict is *bad*.
        device: torch device for the fits.
        progress: called with a task, completed and expected steps, and a note.

    Raises:
        ValueError: the exposures cannot be aligned, or the posterior does not converge.

    Example:
        >>> import calibration, numpy as np
        >>> rng, light = np.random.default_rng(0), np.linspace(20, 400, 64)
        >>> frames, dark = (rng.normal(100 + 2 * rng.poisson(e, (6, 64, 64)), 2).round() for e in (light, 0))
        >>> burst, dark = calibration.Burst(frames), calibration.Burst(dark, calibration=True)
        >>> findings = calibration.calibrate_exposures(burst, dark=dark, kinds=["gaussian"])
        >>> findings.verdict.grade, round(findings.figures.read_noise.median)
        ('good', 1)
    """
    measured = measure_exposures(exposures, dark=dark, flat=flat, offset=offset, seed=seed, progress=progress)
    pixels = collect_pixels(measured.pairs, seed=seed)
    physical = measured.figures is not None and measured.figures.source == "posterior"
    likely = tuple(map(float, measured.detector.posterior.most_likely)) if physical and measured.detector else None
    if kinds is None and measured.figures is not None and measured.verdict.grade == "bad":
        kinds = [*SIMPLE, "signal-gaussian"]  # flexible ones would learn the fault, for ten times as long
    scores = fit_models(pixels, kinds=kinds, detector=likely, seed=seed, device=device, progress=progress)  # type: ignore[arg-type]
    return replace(measured, pixels=pixels, scores=scores)


def measure_exposures(
    exposures: Sequence[ExposurePair] | Burst,
    *,
    dark: Burst | None = None,
    flat: Burst | None = None,
    offset: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Findings:
    """Align exposures, measure the detector and test its results, without noise models; arguments as `calibrate_exposures`."""
    pairs: Any = () if isinstance(exposures, Burst | ExposurePair) else exposures
    known = isinstance(exposures, Burst) or (len(pairs) > 0 and all(isinstance(each, ExposurePair) for each in pairs))
    if not known or not all(isinstance(frames, Burst | None) for frames in (dark, flat)):
        raise TypeError("give a list of ExposurePair(short, long), or Burst(frames); dark and flat are Bursts too")
    for frames in (dark, flat):
        if frames is not None:
            frames.require_unsaturated(dark=frames is dark)
    raw = (exposures.frames[0], None) if isinstance(exposures, Burst) else (exposures[0].short, exposures[0].long)
    beside = flat, dark
    exposures, (join, joined) = below_joins(exposures)
    hot, pattern = np.zeros((), bool), None
    if dark is not None:
        dark, hot, pattern = dark_pattern(exposures, dark)
    exposures = exposures if pattern is None else without_pattern(exposures, pattern, hot)
    burst = None
    if isinstance(exposures, Burst):
        pairs, burst = align_burst(exposures)
    else:
        pairs = []
        for number, pair in enumerate(exposures):
            if progress is not None:
                progress("Aligning exposures", number, len(exposures), "")
            pairs.append(align_pair(pair))
        # common to both exposures, as its error is
        if dark is not None and pattern is not None and np.any(pattern[~hot]):
            number, noise = len(dark.frames), float(dark.frames.var(axis=0, ddof=1).mean())
            error = [(1 - pair.scaling.slope) ** 2 / number for pair in pairs]
            pairs = [replace(pair, pattern=(share * noise, share)) for pair, share in zip(pairs, error, strict=True)]
    pairs = [replace(pair, mask=pair.mask & ~hot) for pair in pairs]
    pairs, repairs = repaired(pairs)
    repairs = replace(repairs, join=join, joined=joined)
    correlation = correlation_of(pairs)
    if correlation.found and not repairs.refitted:
        pairs = [_own_noise_by_scale(pair) for pair in pairs]
    detector, figures, reason = None, None, ""
    case = CalibrationCase(correlation, raw[0], raw[1], *beside, pairs, repairs)
    try:
        detector = measure_detector(pairs, dark=dark, flat=flat, offset=offset, seed=seed, progress=progress)
        figures = figures_of(detector, correlation, repairs)
        verdict = judge(replace(case, detector=detector, figures=figures))
    except (NotMeasurable, np.linalg.LinAlgError) as error:
        # of a likelihood whose curvature matrix is singular
        contradicted = (
            "the pixel values do not fit a Poisson-Gaussian detector; use raw frames, neither compressed nor rescaled"
        )
        reason = str(error) if isinstance(error, NotMeasurable) else contradicted
        verdict = refusal(case, reason)
    return Findings(pairs, None, (), detector, reason, burst, figures, verdict, correlation, repairs, pattern)


def _own_noise_by_scale(pair: AlignedPair) -> AlignedPair:
    """Return the pair with the signal's noise computed from the exposure ratio: a filter removed it from the finest band."""
    if pair.frames > 1 or not 0 < pair.scaling.slope < 1:
        return pair
    share, total = pair.scaling.slope / (1 + pair.scaling.slope), pair.total_variance
    return replace(pair, signal_variance=VarianceLine(share * total.floor, share * total.rate))


def dark_pattern(exposures: Sequence[ExposurePair] | Burst, dark: Burst) -> tuple[Burst, Mask, Image | None]:
    """Return the dark frames with hot pixels replaced, these pixels, and the fixed pattern of the frames as they were, (y, x)
    counts; None if it is not significant.

    The mean of the others is not part of the pattern, so the exposures keep their offset.

    Raises:
        ValueError: the dark frames differ in size from the exposures, or are brighter.
    """
    mean = dark.frames.mean(0)
    first = exposures.frames[0] if isinstance(exposures, Burst) else exposures[0].short
    if mean.shape != first.shape:
        raise ValueError(f"{dark.name}: {mean.shape} pixels, the exposures {first.shape}; use one binning and region")
    if mean.mean() >= first.mean():
        raise ValueError(
            f"{dark.name}: the mean is {mean.mean():.5g} counts, that of the exposure {first.mean():.5g}; dark frames must not "
            "be brighter: swap the files, or record dark frames at the same offset setting"
        )
    noise = float(dark.frames.var(axis=0, ddof=1).mean()) / len(dark.frames)
    hot = np.any(defects(mean[None]), axis=0)  # their dark current has shot noise of its own
    good = replace(dark, frames=_mended(dark.frames, hot))
    pattern = (mean - good.frames.mean()) * (hot | (np.var(mean[~hot]) > 2 * noise))
    return good, hot, pattern if pattern.any() else None


def without_pattern(
    exposures: Sequence[ExposurePair] | Burst, pattern: Image, hot: Mask
) -> Sequence[ExposurePair] | Burst:
    """Subtract a fixed pattern, (y, x) counts, from the exposures, with `hot` pixels replaced: interpolation would spread them.

    Values at a clipping limit stay equal: all are clipped where all pixels but `CLIPPED`, which are hot, reach after the
    subtraction.
    """
    less = partial(_less, pattern=_mended(pattern, hot), hot=hot)
    if isinstance(exposures, Burst):
        return replace(exposures, frames=np.stack([less(frame) for frame in exposures.frames]))
    return [replace(pair, short=less(pair.short), long=less(pair.long)) for pair in exposures]


def _mended(frames: Image, hot: Mask) -> Image:
    return np.asarray(np.where(hot, np.roll(frames, (2, 2), (-2, -1)), frames))


def _less(frame: Image, pattern: Image, hot: Mask) -> Image:
    frame = _mended(frame, hot)
    low, high = rails(frame)
    least, most = np.quantile(pattern, (CLIPPED, 1 - CLIPPED))
    less = np.clip(frame - pattern, low - least, high - most)
    return np.asarray(np.where(frame <= low, low - least, np.where(frame >= high, high - most, less)))


def saved_model(model: nn.Module, findings: Findings) -> nn.Module:
    """Return the model for raw frames: it adds the pattern of the dark frames if that was subtracted before the fit."""
    if findings.pattern is None:
        return model
    return noiseflow.WithMaps(model, offset=findings.pattern)
