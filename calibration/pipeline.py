"""The whole calibration in one call: align, measure the detector, fit and judge the noise models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.detector.correlation import Correlation, correlation_of
from calibration.detector.figures import Figures, figures_of
from calibration.detector.importance import DRAWS, ROUNDS
from calibration.detector.measure import Detector, measure_detector
from calibration.detector.models import KINDS, ModelScore, Pixels, collect_pixels, fit_models
from calibration.detector.photon_transfer import NotMeasurable
from calibration.detector.repair import Repairs, repaired
from calibration.exposures.codes import below_joins
from calibration.exposures.frames import Burst, ExposurePair, Image
from calibration.exposures.scaling import VarianceLine
from calibration.registration.aligned import AlignedPair, align_pair
from calibration.registration.bursts import BurstReport, align_burst
from calibration.verdict import Reason, Verdict, compression, judge_calibration, verdict_of
from noiseflow.described import described

if TYPE_CHECKING:
    from torch import nn

    from noiseflow.commands.console import Progress

Bar = Callable[[str, int], AbstractContextManager["Progress | None"]]
"""``bar(title, total)``: a context that gives a progress callback."""

CONTRADICTED = (
    "the pixel values contradict every Poisson-Gaussian detector; give raw frames, neither compressed nor rescaled"
)
"""Why likelihoods have no curvature left."""


@described()
@dataclass(frozen=True)
class Findings:
    """All that a calibration found.

    Attributes:
        pairs: aligned pairs, or the frames of a burst.
        pixels: what the models were fitted to and judged by.
        scores: of the models.
        detector: None where no gain shows.
        no_detector: why not.
        burst: what moved or faded; None for pairs.
        figures: gain, offset and read noise as reported; None where no gain shows.
        verdict: how far they can be believed.
        correlation: between the residuals of neighbouring pixels.
        repairs: what of the exposures was modelled before the detector was measured.
        pattern: (y, x) fixed pattern of the dark frames that was subtracted, counts, mean 0; None: none was.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> dark = camera(torch.full((6, 64, 64), 100.0)).sample(generator=torch.Generator().manual_seed(1)).round()
        >>> findings = calibration.calibrate_exposures(
        ...     calibration.Burst(frames), dark=calibration.Burst(dark, calibration=True), kinds=["gaussian"]
        ... )
        >>> findings.verdict.grade, round(findings.figures.gain.median, 1), [score.name for score in findings.scores]
        ('good', 2.0, ['gaussian'])
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
    kinds: Sequence[str] | None = None,
    seed: int = 0,
    device: Any = "cpu",
    bar: Bar = lambda title, total: nullcontext(),
) -> Findings:
    """Align exposures, measure the detector, and fit and judge every noise model.

    Args:
        exposures: pairs, or one burst.
        dark: frames without light.
        flat: equal frames of even illumination.
        kinds: noise models to fit; see `fit_models`.
        seed: of every random choice.
        device: torch device of the fits.
        bar: makes progress bars.

    Raises:
        ValueError: exposures that cannot be aligned, or a posterior that does not converge.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> dark = camera(torch.full((6, 64, 64), 100.0)).sample(generator=torch.Generator().manual_seed(1)).round()
        >>> findings = calibration.calibrate_exposures(
        ...     calibration.Burst(frames), dark=calibration.Burst(dark, calibration=True), kinds=["gaussian"]
        ... )
        >>> findings.verdict.grade, round(findings.figures.read_noise.median)
        ('good', 1)
    """
    measured = measure_exposures(exposures, dark=dark, flat=flat, seed=seed, bar=bar)
    pixels = collect_pixels(measured.pairs, seed=seed)
    physical = measured.figures is not None and measured.figures.source == "posterior"
    likely = tuple(map(float, measured.detector.posterior.most_likely)) if physical and measured.detector else None
    with bar("Fitting noise models", len(KINDS)) as progress:
        scores = fit_models(pixels, kinds=kinds, detector=likely, seed=seed, device=device, progress=progress)  # type: ignore[arg-type]
    return replace(measured, pixels=pixels, scores=scores)


def measure_exposures(
    exposures: Sequence[ExposurePair] | Burst,
    *,
    dark: Burst | None = None,
    flat: Burst | None = None,
    seed: int = 0,
    bar: Bar = lambda title, total: nullcontext(),
) -> Findings:
    """Align exposures, measure the detector and judge its figures, without fitting noise models. As `calibrate_exposures`."""
    pattern = None
    for frames in (dark, flat):
        if frames is not None:
            frames.require_unsaturated()
    if dark is not None:
        pattern = dark_pattern(exposures, dark)
        exposures = exposures if pattern is None else without_pattern(exposures, pattern)
    exposures, (join, joined) = below_joins(exposures)
    burst = None
    if isinstance(exposures, Burst):
        pairs, burst = align_burst(exposures)
    else:
        pairs = [align_pair(pair) for pair in exposures]
    pairs, repairs = repaired(pairs)
    repairs = replace(repairs, join=join, joined=joined)
    correlation = correlation_of(pairs)
    if correlation.found and not repairs.refitted:
        pairs = [_own_noise_by_scale(pair) for pair in pairs]
    detector, figures, reason = None, None, ""
    verdict = Verdict("bad", ())
    try:
        with bar("Sampling the detector's posterior", DRAWS * ROUNDS) as progress:
            detector = measure_detector(pairs, dark=dark, flat=flat, seed=seed, progress=progress)
        figures = figures_of(detector, correlation, repairs)
        verdict = judge_calibration(pairs, detector, figures, correlation, repairs)
    except (NotMeasurable, np.linalg.LinAlgError) as error:
        reason = str(error) if isinstance(error, NotMeasurable) else CONTRADICTED
        refused = Reason("not measurable", "bad", f"the detector was not measured: {reason}.")
        verdict = verdict_of([refused, *compression(pairs)])
    return Findings(pairs, None, (), detector, reason, burst, figures, verdict, correlation, repairs, pattern)


def _own_noise_by_scale(pair: AlignedPair) -> AlignedPair:
    """The pair with the signal's own noise from the exposures' scale: a filter has taken it out of the finest band."""
    if pair.frames > 1 or not 0 < pair.scaling.slope < 1:
        return pair
    share = pair.scaling.slope / (1 + pair.scaling.slope)
    total = pair.total_variance
    return replace(pair, signal_variance=VarianceLine(share * total.floor, share * total.rate))


def dark_pattern(exposures: Sequence[ExposurePair] | Burst, dark: Burst) -> Image | None:
    """The dark frames' fixed pattern, (y, x) counts of mean 0, where the mean dark frame knows it better than its own noise;
    else None.

    The pattern's mean stays in the exposures, so that the offset does.

    Raises:
        ValueError: dark frames of another size, or brighter than the exposures.
    """
    mean = dark.frames.mean(0)
    first = exposures.frames[0] if isinstance(exposures, Burst) else exposures[0].short
    if mean.shape != first.shape:
        raise ValueError(
            f"{dark.name}: {mean.shape} pixels, but the exposures have {first.shape}; take dark frames with the same "
            "binning and region"
        )
    if mean.mean() >= first.mean():
        raise ValueError(
            f"{dark.name}: mean {mean.mean():.5g} counts, the exposure {first.mean():.5g}; dark frames cannot be the "
            "brighter ones: swap them, or take them at the same offset setting"
        )
    noise = float(dark.frames.var(axis=0, ddof=1).mean()) / len(dark.frames)
    return None if np.var(mean) < 2 * noise else np.asarray(mean - mean.mean())


def without_pattern(exposures: Sequence[ExposurePair] | Burst, pattern: Image) -> Sequence[ExposurePair] | Burst:
    """Exposures less a fixed pattern, (y, x) counts."""
    if isinstance(exposures, Burst):
        return replace(exposures, frames=exposures.frames - pattern)
    return [_less(pair, pattern) for pair in exposures]


def saved_model(model: nn.Module, findings: Findings) -> nn.Module:
    """The model as it applies to raw frames: with the dark frames' pattern, where that was subtracted before it was fitted."""
    if findings.pattern is None:
        return model
    import noiseflow

    return noiseflow.WithMaps(model, offset=findings.pattern)


def _less(pair: ExposurePair, pattern: Image) -> ExposurePair:
    return replace(pair, short=pair.short - pattern, long=pair.long - pattern)
