"""The checks of a calibration, one row each: what is measured, what is tolerated, and what to do."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calibration.detector.correlation import Correlation, contained_share, correlation_in_time, correlation_of_flats
from calibration.detector.emva import CameraFigures
from calibration.detector.figures import Figures, correctable, disagreement, least_skew
from calibration.detector.measure import Detector
from calibration.detector.patterns import AMPLIFIERS, MOSAICS, Pattern, pattern_of
from calibration.detector.photon_transfer import Level, departure, level_of
from calibration.detector.posterior import NINETY
from calibration.detector.repair import Repairs
from calibration.detector.response import EXPONENTS, LINEAR, PRIOR, Response
from calibration.exposures.frames import Burst, Image, rounding_step
from calibration.exposures.processing import block_compressed, wavelet_compressed
from calibration.exposures.scaling import VarianceLine
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import (
    ANY,
    CLEAR,
    CLIPPED,
    GAIN,
    LARGEST_RATIO_ERROR,
    LEVEL,
    LIKELY,
    MISFIT,
    MODELLED,
    MOST_LEFT_OUT,
    PIXELS,
    SCENE,
    UNEVEN,
)
from noiseflow.checks import Check, Effect, Guard, NotTested, Verdict, run, verdict_of

RAW = "use raw frames"
LAG = "leave more time between frames, and switch off averaging in the camera"
GOOD = "all assumptions passed their tests"
UNSEEN = (
    "three equal frames, here or as --dark, would show a camera that averages successive ones, and two exposures do not"
)


@dataclass(frozen=True)
class CalibrationCase:
    """A calibration to assess, from exposures of a scene or from flats and darks.

    Attributes:
        correlation: correlation of the noise of neighbouring pixels.
        frame: (y, x) raw frame, the short exposure or the first of a burst; None for flats.
        long: (y, x) raw long exposure; None for bursts and flats.
        flat, dark: raw frames of these kinds; None without.
        pairs, repairs, detector, figures: results from exposures of a scene.
        camera: results from flats and darks.
    """

    correlation: Correlation
    frame: Image | None = None
    long: Image | None = None
    flat: Burst | None = None
    dark: Burst | None = None
    pairs: Sequence[AlignedPair] = ()
    repairs: Repairs = field(default_factory=Repairs)
    detector: Detector | None = None
    figures: Figures | None = None
    camera: CameraFigures | None = None

    @property
    def flats(self) -> CameraFigures:
        """Results from flats and darks. Raises `NotTested` without them."""
        if self.camera is None:
            raise NotTested("there are no flats")
        return self.camera

    @property
    def measured(self) -> Detector:
        """Results from exposures of a scene. Raises `NotTested` without them."""
        if self.detector is None:
            raise NotTested("the detector was not measured")
        return self.detector

    @property
    def gain(self) -> float:
        """Reported gain, counts per electron."""
        found = self.camera if self.camera is not None else self.figures
        return np.nan if found is None else found.gain.median

    @property
    def darkness(self) -> Level:
        """Moments of the dark frames. Raises `NotTested` without them."""
        found = self.camera or self.detector
        if found is None or found.dark is None:
            raise NotTested("there are no dark frames, or none are needed")
        return found.dark

    @property
    def bands(self) -> Repairs | CameraFigures:
        """What knows the offsets of rows and columns."""
        return self.repairs if self.camera is None else self.camera

    @property
    def response(self) -> Response:
        """Exponent of the response to light."""
        return self.camera.bend if self.camera is not None else self.detector.response if self.detector else LINEAR

    @cached_property
    def pattern(self) -> Pattern:
        """Dependence of the noise on the place; none if the frames were resampled, which has a pattern of its own."""
        if self.correlation.found and self.correlation.period:
            return Pattern()
        if self.camera is not None:
            return self.camera.pattern
        # residuals from a mean that the frames of a burst share
        shared = self.pairs[0].frames / max(self.pairs[0].frames - 1, 1)
        inflation = self.correlation.inflation * np.sqrt(shared)
        return pattern_of([pair.residual for pair in self.pairs], inflation=inflation)

    @property
    def classes(self) -> bool:
        """Whether classes of pixels have gains of their own: they have a period, and give both exposures the same detail."""
        return bool(self.pattern.factors) and self.pattern.relative > GAIN

    @property
    def electrons(self) -> bool:
        """Whether single-electron peaks show: no filter leaves them intact, and they determine the gain."""
        return self.detector is not None and self.detector.electrons

    @property
    def filtered(self) -> bool:
        """Whether the correlation is that of a short filter, before which the gain is reported."""
        # the factor of sharpened frames is poorly known
        known = self.correlation.local and self.correlation.factor > 0.5
        return known and (self.camera is not None or correctable(self.correlation, self.repairs))


def _shown(case: CalibrationCase, *, filtered: bool) -> Effect:
    """Change of the gain by correlated pixels."""
    found = case.correlation
    if not found.found or case.electrons or case.filtered != filtered:
        return Effect(0.0)
    lag = int(np.argmax(np.abs(found.value)))
    distance, value = tuple(int(step) for step in found.lags[lag]), float(found.value[lag])
    what = f"at a distance of (y, x) = {distance} by {value:+.3f}"
    return Effect(found.factor - 1 if found.local else value, found.factor_error if filtered else 0.0, what)


def _coarse(case: CalibrationCase) -> Effect:
    hidden = case.darkness.coarse if case.camera else case.darkness.variance <= 0  # of a scene, a bound of it is enough
    return Effect(hidden > case.darkness.clipped)


def _period(case: CalibrationCase, *, linear: bool) -> Effect:
    found = case.correlation
    known = found.step != 1 and case.filtered
    if not found.period or case.classes or case.electrons or known != linear:
        return Effect(0.0)
    return Effect(found.period, what=f" by {1 / found.step:.2g} with linear interpolation" if linear else "")


def _misfit(case: CalibrationCase, *, corrected: bool) -> Effect:
    """Largest share of the residual variance that follows the scene; corrected if a kernel leaves no share and no correlation."""
    repairs = case.repairs
    if not repairs.scene:
        return Effect(0.0)
    before, after = (max(fits, key=lambda one: one.share) for fits in (repairs.scene, repairs.scene_after))
    left = case.correlation.found or (after.clear and after.share > SCENE)
    if (repairs.refitted and not left) != corrected or before.share <= SCENE:
        return Effect(0.0)
    dark = ", or light fell on the dark frames" * (before.cause == "illumination" and case.dark is not None)
    return Effect(before.share, before.error, CAUSES[before.cause] + dark)


CAUSES = {
    "blur": "one exposure is blurred, drifted or differs in focus",
    "illumination": "light or dose changed across the field",
    "response": "one exposure is not linear in the signal",
    "parts": "halves or quadrants have amplifiers with offsets of their own: give --dark, or calibrate each alone by --region",
    "mosaic": "the scene moved over a mosaic of colour filters, so that the exposures show different colours at its places: "
    "avoid motion, or give one colour",
}


def _gains(case: CalibrationCase) -> Effect:
    most = max([pair.gains or (0.0, 0.0, 0.0) for pair in case.pairs], key=lambda one: one[-1])
    return Effect(most[-1], what=f"{most[0]:.1%}")


def _hidden(case: CalibrationCase) -> Effect:
    share, error = max(one.hidden or (0.0, 0.0) for one in case.pairs)
    return Effect(share, error)


def _doses(case: CalibrationCase) -> Effect:
    # slopes are relative to the mean of the other frames
    doses = [1 / (1 / max(one.scaling.slope, 1e-30) + 1 / one.frames) for one in case.pairs if one.frames > 1]
    return Effect(float(np.ptp(np.log(doses or [1.0]))))


def _lag(case: CalibrationCase) -> Effect:
    if case.camera is not None:
        lag, error = case.camera.lag
    else:  # less noise than a code keeps step with offsets of rows
        beside = [one for one in (case.flat, case.dark) if one is not None and not level_of(one).coarse]
        if max(case.pairs[0].frames, *(len(one.frames) for one in beside), 0) <= 2:
            raise NotTested(UNSEEN)
        found = correlation_in_time(case.pairs), correlation_of_flats(beside)
        lag, error = max(found, key=lambda one: abs(one[0]))
    return Effect(2 * lag, 2 * error, f"{lag:+.3f}")  # the variance of differences changes by twice the correlation


def _classes(case: CalibrationCase) -> Effect:
    if not case.pattern.factors:
        return Effect(0.0)
    camera, name = case.camera, case.pattern.name
    images = [(one.image, one.noise, np.ones(one.image.shape, bool)) for one in camera.linear] if camera else []
    images += [(one.signal, (one.observation - one.signal) ** 2, one.mask) for one in case.pairs]
    y, x = np.indices(images[0][0].shape)
    masks = [{**AMPLIFIERS, **MOSAICS}[name](y, x, y.shape) == each for each in range(len(case.pattern.factors))]
    points = [[np.concatenate([one[of][one[2] & part] for one in images]) for of in (0, 1)] for part in masks]
    factor, found = case.correlation.factor if case.filtered else 1.0, [case.gain * one for one in case.pattern.factors]
    if camera or name in AMPLIFIERS:  # whose offsets differ, too; the pixels of a mosaic see the same scene
        found = [factor * VarianceLine.fitted(signal, squares).rate for signal, squares in points]
    gains = ", ".join(f"{one:.4g}" for one in found)
    return Effect(case.pattern.relative, case.pattern.error, f"{name}, with gains of {gains} counts/e⁻")


def _response(case: CalibrationCase) -> Effect:
    found = case.response
    if not found.known:
        raise NotTested("the exposures do not determine the response")
    return Effect(found.exponent - 1, abs(found.exponent - 1) / (found.excess or 1), f"{found.exponent:.3f}")


def _compressed(frame: Image | None) -> Effect:
    if frame is None:
        raise NotTested("there is no such frame")
    if block_compressed(frame):
        return Effect(1.0, what="in blocks of 8 × 8 pixels (JPEG)")
    kind = "by wavelets (JPEG 2000), or every second pixel was interpolated"
    return Effect(1.0, what=kind) if wavelet_compressed(frame) else Effect(0.0)


def _averaged(case: CalibrationCase) -> Effect:
    """Frames in a mean, whose values are multiples of a fraction of a count, and no numbers between 0 and 1."""
    found = {}
    flat, dark = (None if one is None else one.frames[0] for one in (case.flat, case.dark))
    for name, frame in {"": case.frame, " of the flat frames": flat, " of the dark frames": dark}.items():
        if frame is not None and 0 < (step := rounding_step(frame)) < 1 < np.ptp(frame):
            multiples = np.array([1, frame.min()]) / step
            found[name] = round(1 / step) * bool(np.allclose(multiples, np.round(multiples)))
    name, number = max(found.items(), key=lambda one: one[1], default=("", 0))
    return Effect(number, what=name)


def _joined(case: CalibrationCase, *, few: bool) -> Effect:
    share = case.repairs.joined
    return Effect(share if (share <= MOST_LEFT_OUT) == few else 0.0, what=f"{case.repairs.join:.5g} counts")


def _ratio(case: CalibrationCase) -> Effect:
    ratios = [pair.scaling.slope * pair.exposure_ratio for pair in case.pairs if pair.exposure_ratio is not None]
    worst = max((abs(float(np.log(one))) if one > 0 else np.inf for one in ratios), default=0.0)
    return Effect(worst, what=f"{1 / case.pairs[0].scaling.slope:.3g}" if worst else "")


def _full(case: CalibrationCase) -> Effect:
    """Share of the pixels at bright levels without half of their shot noise, which a full well removes."""
    line, levels = case.measured.line, case.measured.levels
    if not levels:
        raise NotTested("the detector counts photons")
    count = np.concatenate([one.count for one in levels])
    # what may be removed too much with the gains of pixels, whose variance grows with the square of the light
    gains = max(sum(pair.gains[:1]) for pair in case.pairs) * (line.signal - line.signal.min())
    full = line.variance + LIKELY * MODELLED * 2 * gains**2 < 0.5 * (line.gain * line.signal + line.intercept)
    full &= line.signal > np.average(line.signal, weights=count)
    return Effect(float(count[full].sum() / count.sum()))


def _subtracted(case: CalibrationCase) -> Effect:
    """Offset from the noise of frames from which an offset was subtracted, whose own one is 0 unless more was subtracted; values
    further below 0 than noise are those of signed codes."""
    found = case.figures.offset if case.figures and case.measured.offset is None else None
    least = np.nan if case.frame is None else case.frame.min()
    if found is None or not 0 > least > -CLEAR * case.pairs[0].residual.spread.max():
        return Effect(0.0)
    return Effect(found.median, (found.q95 - found.q05) / (2 * NINETY))


def _offsets(case: CalibrationCase) -> Effect:
    """The known offset less the one that two exposures of one setting share, relative to the signal, and thus of the gain."""
    known = case.measured.offset
    pair = next((one for one in case.pairs if one.plain_ratio is not None), None)
    if known is None or pair is None:
        raise NotTested("no offset is known, or no long exposure of the same setting")
    shared, error = pair.scaling.common_offset()
    signal = float(pair.signal[pair.mask].mean()) - shared
    what = f"{shared:.5g}, dark frames or --offset one of {known[0]:.5g}"
    return Effect((known[0] - shared) / signal, float(np.hypot(known[1], error)) / signal, what)


def _levels(case: CalibrationCase) -> Effect:
    used = len(case.flats.linear)
    what = f"{used} level{'s' * (used > 1)} of light{' without clipped noise' * (used < len(case.flats.levels))}"
    return Effect(max(3 - used, 0), what=what)


def _camera(measure: Callable[[CameraFigures], float]) -> Callable[[CalibrationCase], Effect]:
    return lambda case: Effect(float(measure(case.flats)))


Row = Check[CalibrationCase]
# fmt: off
COMMON: tuple[Row, ...] = (
    Row("clipped darks", "clipped darkness", "fact", lambda case: Effect(case.darkness.clipped), "of the pixels", ANY,
        "{value:.1%} of the dark frames' pixel values are clipped, or all equal: their offset and noise are biased, and "
        "the gain is that of the other frames alone", "increase the camera's offset setting", local=True),
    Row("codes of darks", "coarse codes", "fact", _coarse, "", ANY,
        "the noise of the dark frames is smaller than the rounding step, and is not determined", "use a higher gain setting",
        local=True),
    Row("whole counts", "averaged frames", "fact", _averaged, "", ANY,
        "the pixel values{what} are multiples of 1/{value:.0f}, as in means of so many frames or scaled counts, and gain and "
        "noise are those of the means or the scale", "give single frames as they were recorded", local=True),
    Row("filter", "correlated pixels", "distortion", lambda case: _shown(case, filtered=True), "of the gain", GAIN,
        "the noise of pixels correlates {what}: the frames were filtered or resampled. If the filter preserves the mean, the "
        "gain before it, which is reported, differs by {value:+.1%}", RAW, local=True),
    Row("correlation of pixels", "correlated pixels", "distortion", lambda case: _shown(case, filtered=False), "of the gain",
        GAIN, "the noise of pixels correlates {what}, and no short filter explains it: afterglow, interference, row noise or "
        "strong filters", f"{RAW}, or remove the interference"),
    Row("linear interpolation", "periodic noise", "distortion", lambda case: _period(case, linear=True), "pixels", ANY,
        "the noise has a period of {value:.3g} pixels: the frames were resampled{what}; the gain is corrected to a few percent",
        RAW, local=True),
    Row("period of the noise", "periodic noise", "distortion", lambda case: _period(case, linear=False), "pixels", ANY,
        "the noise has a period of {value:.3g} pixels: the frames were resampled or compressed, and the gain is not that of the "
        "camera", RAW),
    Row("successive frames", "frames correlated", "distortion", _lag, "of the gain", GAIN,
        "the noise of successive frames has a correlation of {what} (image lag, temporal filter or changing scene), and the gain "
        "is wrong by about {value:+.0%}", LAG, score=CLEAR),
    # whichever their size: those subtracted matter
    Row("rows", "row offsets", "distortion", lambda case: Effect(case.bands.rows), "counts", ANY,
        "rows have individual offsets of {value:.3g} counts rms, which were subtracted", "use ScanNoise(model) to model them",
        local=True),
    Row("columns", "column offsets", "distortion", lambda case: Effect(case.bands.columns), "counts", ANY,
        "columns have individual offsets of {value:.3g} counts rms, which were subtracted", "use ScanNoise(model) to model them",
        local=True),
    # significance is that of χ² over all parts; residuals at levels of few electrons are standardised to 2 %
    Row("noise across the field", "uneven field", "distortion",
        lambda case: Effect(0.0) if case.pattern.factors else Effect(case.pattern.relative, case.pattern.error),
        "of the variance", 2 * GAIN,
        "at equal signal the noise variance differs by {value:.1%} rms across the field: the frames were divided by a flat field "
        "or corrected for shading, so no single gain applies", "use uncorrected frames", score=ANY, local=True),
    Row("classes of pixels", "uneven gains", "distortion", _classes, "of the variance", GAIN,
        "at equal signal the noise variance differs by {value:.1%} rms between classes of pixels ({what}): they have amplifiers "
        "or filters of their own", "calibrate each class alone", score=ANY, local=True),
    # an exponent off by one hundredth changes the gain by 2 %; the reported gain is the local one
    Row("response", "nonlinear response", "distortion", _response, "", GAIN / 2,
        "the response is not linear: the signal grows as light^{what}, or dark frames, long exposure or ratio belong to another "
        "setting. The gain is the local one at the mean signal", f"{RAW}, and dark frames of the same setting", score=LIKELY,
        local=True),
    Row("encoding", "nonlinear response", "fact",
        lambda case: Effect(float(case.response.bent and case.response.exponent < EXPONENTS.min() + PRIOR)), "",
        ANY, "the response is far from linear, as that of encoded images (gamma, logarithm): they have no single gain", RAW),
)

SCENES: tuple[Row, ...] = (
    Row("compression", "compressed", "fact", lambda case: _compressed(case.frame), "", ANY,
        "the frames were compressed with loss {what}, which removes noise and adds artefacts", RAW),
    Row("compression of the long exposure", "compressed", "fact", lambda case: _compressed(case.long), "", ANY,
        "the long exposure was compressed with loss {what}", RAW, local=True),
    # a join shifts the photon-transfer line by about the share of the pixels above it
    Row("converters, joined", "joined converters", "fact", lambda case: _joined(case, few=True), "of the pixels", PIXELS,
        "{value:.1%} of the pixels, above {what}, use fewer of the converter's codes (high dynamic range, companded values); "
        "they are treated as clipped, and the results apply to darker pixels", "record with a single converter setting",
        local=True),
    Row("converters, mixed", "joined converters", "fact", lambda case: _joined(case, few=False), "of the pixels", PIXELS,
        "{value:.1%} of the pixels, above {what}, use fewer of the converter's codes (high dynamic range, companded values), and "
        "no single gain fits both ranges", "record with a single converter setting"),
    Row("full well", "saturation", "fact", _full, "of the pixels", CLIPPED,
        "{value:.1%} of the pixels are at full-well saturation, below the converter's upper limit", "use a shorter exposure",
        local=True),
    Row("exposure ratio", "exposure ratio", "distortion", _ratio, "of the logarithm", LARGEST_RATIO_ERROR,
        "the fitted ratio of the exposures is {what} and contradicts the given one, which was not used: it is wrong, or the "
        "exposures differ in gain or processing", "check --exposure-ratio, or leave it out", local=True),
    # in 18 simulated pairs with hot pixels, the gain was too high by three to five times this share
    Row("hot pixels", "hot pixels", "distortion", _hidden, "of the variance", LEVEL,
        "hot pixels or rays were left out, but weaker ones remain, with about {value:.1%} of the variance, and the gain is too "
        "high by several times that share", "give --dark", score=LIKELY, local=True),
    Row("gains of pixels", "fixed pattern", "distortion", _gains, "of the residual variance", SCENE,
        "the gains of the pixels differ by {what} rms (fixed pattern), and the scene moved over them. The variance from this was "
        "removed, to {value:.1%} of the rest; offset and read noise are less certain", "record both without motion", local=True),
    Row("changed regions", "scene changed", "distortion", lambda case: Effect(case.repairs.changed), "of the pixels", PIXELS,
        "{value:.1%} of the pixels lie in regions that changed between the exposures, and were excluded",
        "check the residual map, or record a static scene", local=True),
    Row("static scene", "scene changed", "distortion", lambda case: Effect(case.repairs.changed), "of the pixels", MOST_LEFT_OUT,
        "{value:.1%} of the pixels lie in regions that changed between the exposures", "record a static scene"),
    Row("fit to the scene, corrected", "scene misfit", "distortion", lambda case: _misfit(case, corrected=True),
        "of the residual variance", SCENE,
        "{value:.1%} of the residual variance follows the scene ({what}); a convolution kernel between the exposures corrects it "
        "to a few percent of the gain", "repeat the exposures for a smaller error", score=CLEAR, local=True),
    # what a kernel leaves is no blur, and changes the gain by many times its share
    Row("fit to the scene", "scene misfit", "distortion", lambda case: _misfit(case, corrected=False),
        "of the residual variance", lambda case: SCENE / (3 if case.repairs.refitted else 1),
        "{value:.1%} of the residual variance follows the scene ({what})", "repeat the exposures", score=CLEAR),
    Row("separate exposures", "short contained", "distortion",
        lambda case: Effect(0.0 if case.classes else max(map(contained_share, case.pairs))), "of the gain", GAIN,
        "{value:.1%} of the long exposure's signal is the short exposure itself, and the gain is too low by the same share",
        "use a short exposure that is not part of the long one"),
    # alternate doses in a ratio of 1.2 left the gain right, and of 1.5 made it 2 to 4 % too high
    Row("light of frames", "unequal frames", "distortion", _doses, "of the logarithm", LARGEST_RATIO_ERROR,
        "the light of the burst's frames differs by {value:.0%}", "give frames of one exposure time", local=True),
    Row("code widths", "uneven codes", "distortion", lambda case: Effect(case.measured.codes), "rms", UNEVEN,
        "the converter's codes are uneven: each width differs by {value:.0%} rms from its neighbours (rescaled and rounded "
        "again, or two converters). A noise model with equal rounding steps does not reproduce them", RAW, local=True),
    Row("variances of pixels", "uneven pixels", "distortion", lambda case: Effect(case.measured.uneven), "rms", UNEVEN,
        "the variances of individual pixels differ by {value:.0%} rms at equal signal (sCMOS, hot pixels); the gain is that of "
        "photon transfer", "calibrate with flats and darks for per-pixel maps", local=True),
    Row("shape of the noise", "not Poisson-Gaussian", "predictive", lambda case: Effect(case.measured.misfit),
        "χ² per degree of freedom", MISFIT,
        "the histograms do not fit a Poisson-Gaussian detector (χ² per degree of freedom {value:.2f}); the gain is that of "
        "photon transfer, which includes the excess-noise factor", "only dark frames determine offset and read noise",
        null=1.0, local=True),
    Row("skew of the noise", "not Poisson-Gaussian", "predictive", lambda case: case.measured.skew,
        "of that of Poisson noise", least_skew,
        "the noise is more skewed than Poisson noise, by {value:.0%}, as with multiplied electrons (EMCCD); the gain is that of "
        "photon transfer, which includes the excess-noise factor", "only dark frames determine offset and read noise",
        score=CLEAR, local=True),
    Row("shape and variance", "shape against variance", "predictive", lambda case: disagreement(case.measured), "of the gain",
        GAIN, "the shape of the noise gives another gain than its variance, by {value:+.1%}; the gain is that of photon transfer",
        "only dark frames determine offset and read noise", score=LIKELY, local=True),
    Row("negative values", "offset subtracted", "predictive", _subtracted, "counts", ANY,
        "the frames have negative values, so an offset was subtracted, but their noise gives one of {value:.3g} counts, as if "
        "electrons were multiplied (EMCCD) or a background subtracted, too; offset and read noise are those without either",
        "give --offset 0, or --dark", score=LIKELY, local=True),
    Row("offsets", "offsets differ", "distortion", _offsets, "of the signal", GAIN,
        "the brightness of the two exposures implies an offset of {what} counts: another setting or temperature, which changes "
        "the gain by about {value:+.1%}, or dark current, which does not", "record dark frames with the exposures",
        local=True),
    Row("line of variance", "bent line", "predictive", lambda case: departure(case.measured.line),
        "of the largest variance", GAIN,
        "the variance is not linear in the signal, by {value:.1%}: saturation, rescaled values, or a change of light",
        "check the photon-transfer plot", local=True),
)

FLATS: tuple[Row, ...] = (
    # typical instability of sources between equal frames
    Row("light", "unsteady light", "distortion", _camera(lambda one: max(level.flicker for level in one.levels)), "", SCENE,
        "the light changed by {value:.1%} between frames (corrected)", "steady it, and give one file for each level", local=True),
    Row("line of variance", "bent line", "predictive", _camera(lambda one: max(one.chi_squared, 1.0)),
        "χ² per degree of freedom", LIKELY, "the variance is not linear in the signal (χ² per degree of freedom {value:.1f}): "
        "flickering light or a nonlinear converter", "check the photon-transfer plot", null=1.0, local=True),
    Row("dark frames", "no dark frames", "predictive", _camera(lambda one: one.dark is None), "", ANY,
        "without dark frames, offset, dark noise, dynamic range, DSNU and PRNU are not determined", "give --dark", local=True),
    Row("levels of light", "few levels", "predictive", _levels, "levels", ANY,
        "{what} cannot reveal a nonlinear response", "give three or more", local=True),
)
# fmt: on

CHECKS: tuple[Row, ...] = (*SCENES, *COMMON)
"""The checks of exposures of a scene."""

CAMERA_CHECKS: tuple[Row, ...] = (*FLATS, *COMMON)
"""The checks of flats and darks."""


def judge(case: CalibrationCase) -> Verdict:
    """Test the assumptions behind the results."""
    guard = Guard()
    found = run(CHECKS if case.camera is None else CAMERA_CHECKS, case, guard)
    evidence = {name: finding.as_dict() for name, finding in found.items()}
    good = GOOD + f"; {UNSEEN}" * (UNSEEN in guard.not_tested.values())
    return verdict_of(found.values(), evidence, good=good, guard=guard)


def refusal(case: CalibrationCase, why: str) -> Verdict:
    """The verdict on exposures whose gain cannot be measured, for the reason `why`; compression may explain it."""
    guard, effect = Guard(), Effect(1.0, what=f"the detector was not measured: {why}")
    row = Row("detector", "not measurable", "fact", lambda case: effect, "", ANY, "{what}", RAW)
    return verdict_of(run([*SCENES[:2], row], case, guard).values(), {}, good="", guard=guard)
