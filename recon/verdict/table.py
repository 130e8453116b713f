"""The checks of a reconstruction, one row each: what is measured, what is tolerated, and what to do."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np

from noiseflow.checks import Check, Effect, NotTested
from recon.series.contrast import MARGIN
from recon.series.tilt_series import as_if_in_radians
from recon.verdict import case as cases
from recon.verdict import pixels, result, sharpness, tilts
from recon.verdict.case import FEWEST, VISIBLE, Case, coarse_pixels
from recon.verdict.geometry import positive
from recon.verdict.lines import displaced_lines, uneven_axis

# coarse pixels, of which the field of view has about thirty; twice as much at its edge. Correct series have at most 0.8 of each
SHIFT, SMOOTH_SHIFT = 0.25, 0.1
# a hundredth of the field of view, in coarse pixels
OFF_AXIS = 0.3
# moves the edge of 64 pixels by half a pixel
DEGREES = 1.0
# from end to end of the series, where few tilts determine it: correct series have up to 4
TURN = 6.0
# a third: correct series need up to a quarter, simulated and real ones (a needle)
SCALE = 0.35
# share of the contrast
BRIGHTNESS = 0.18
# of the structure: correct series leave at most 0.009 beyond replicates
RESIDUAL = 0.012
# share of the error of held-out tilts; correct series gain at most 0.05
GAIN = 0.06
# share of pixels: detectors with strong tails have up to 0.00003
SPIKES = 0.0001
# share of pixels or lines: one in five hundred is harmless
FEW = 0.002
# share of the tilts: more are no exceptions
TILTS = 0.1
ALIGN = "align the series first, or use --refine-alignment"
AXIS = "give --tilt-axis, or use --refine-alignment"
ANGLES = "check the list of tilt angles, its order and its signs"
FLATS = "correct the images with flats and darks first"
MASK = "mask them with --mask FILE, or exclude these images"
BEAM = "normalise the images by their incident beam, or check the mode"


def _strong(case: Case) -> str:
    return "high" if case.series.mode == "linear" else "low"


def _in_radians(case: Case) -> Effect:
    angles = case.series.tilt_angles
    return Effect(10.0 * as_if_in_radians(angles), what=f"{np.ptp(angles):.2f}")


def _gap(case: Case, which: int) -> Effect:
    if _in_radians(case).value:
        raise NotTested("the angles are in radians")
    return Effect(tilts.largest_gaps(case.series.tilt_angles)[which])


def _inner_gap(case: Case) -> Effect:
    if tilts.largest_gaps(case.series.tilt_angles)[2] < FEWEST:
        raise NotTested("there are few tilts")
    return _gap(case, 1)


def _few(case: Case) -> Effect:
    count = tilts.largest_gaps(case.series.tilt_angles)[2]
    return Effect(FEWEST / count if count < FEWEST else 0.0, what=str(count))


def _pixel(measure: Callable[..., Effect], *more: Any) -> Callable[[Case], Effect]:
    return lambda case: measure(case.residuals, *more)


Row = Check[Case]
Tolerance = float | Callable[[Case], float]


def _of_images(
    distortion: str, names: tuple[str, ...], reason: str, unit: str, tolerances: tuple[Tolerance, ...], advice: str
) -> list[Row]:
    """Rows for what scatters from image to image, and for what drifts along the series."""
    parts = (("jitter", "from image to image"), ("drift", "along the series"))

    def measure(part: str) -> Callable[[Case], Effect]:
        return lambda case: attrgetter(part)(case.distortions[distortion])

    return [
        Row(name, reason, "distortion", measure(part), unit, tolerance,
            f"{distortion}: the images differ {where} from what the others predict, by {{value:.2f}} {unit}", advice)
        for name, tolerance, (part, where) in zip(names, tolerances, parts, strict=False)
    ]  # fmt: skip


# fmt: off
FACTS: tuple[Row, ...] = (
    Row("angles in radians", "angles", "fact", _in_radians, "", 1.0,
        "the tilt angles span {what}°, as if they were radians", "give the tilt angles in degrees"),
    Row("missing wedge", "range", "fact", lambda case: _gap(case, 0), "°", 90.0,
        "{value:.0f}° of 180° have no tilts, so most directions of the volume are not measured",
        "add tilts, or trust only structures that face the beam", local=True),
    Row("gap inside the range", "range", "fact", _inner_gap, "°", 15.0,
        "the tilts leave a gap of {value:.0f}° inside their range",
        "add tilts there, or expect streaks in these directions", local=True),
    Row("number of tilts", "range", "fact", _few, "", 1.0,
        "{what} tilt angles are too few for fine detail", "take more tilts", local=True),
    Row("repeated images", "repeats", "fact", lambda case: tilts.repeated(case.series), "of the tilts", 0.0,
        "{value:.0%} of the images are exact copies of another image", "remove the copies", local=True),
    Row("images scaled one by one", "beam", "fact", lambda case: tilts.normalised(case.series), "", 0.5,
        "every image has the same mean and deviation, or the same range: each was scaled by itself",
        "give the images as recorded", local=True),
    Row("images of one direction", "angles", "fact", lambda case: tilts.twins(case.coarse), "of the structure", 0.03,
        "images of the same direction differ by {value:.0%} of their structure", ANGLES),
    Row("saturation", "saturation", "fact", lambda case: pixels.saturated(case.residuals, _strong(case)), "of the pixels",
        0.005, "{value:.1%} of the pixels and all their neighbours are at the limit of strong contrast, {what}",
        "use a series that is not saturated, or mask these parts", local=True),
    # 0.0003 in correct series
    Row("pixels at a limit", "saturation", "fact", lambda case: pixels.piled(case.residuals, _strong(case)), "of the pixels",
        0.004, "{value:.1%} of the pixels are at the limit of strong contrast, {what}, more than just inside it",
        "use a series that is not saturated, or mask these parts", local=True),
    # ratio; 3.2 in correct series
    Row("end of the pixel values", "saturation", "fact", _pixel(pixels.cliff), "", 12.0,
        "the pixel values end abruptly at {what}, as if brighter ones had wrapped around or been removed",
        "check the data type in which the images were saved", local=True),
    Row("spikes", "outliers", "fact", _pixel(pixels.spikes), "of the pixels", SPIKES,
        "{value:.2%} of the pixels deviate from the others by more than 5 times their range",
        "mask the spikes with --mask FILE, or replace them", local=True),
    Row("dead pixels", "lines", "fact", _pixel(pixels.dead_pixels), "of the pixels", FEW,
        "{value:.1%} of the pixels have a constant value in all tilts, unlike those around them", MASK, local=True),
    Row("streaks", "lines", "fact", _pixel(pixels.streaks), "of the lines", FEW,
        "{value:.1%} of the {what} of single images differ from their neighbours", MASK, local=True),
    # unspoilt series have up to 0.2
    Row("displaced lines", "lines", "distortion", _pixel(displaced_lines), "pixels", 0.4,
        "the lines of the images are displaced along themselves, by {value:.1f} pixels",
        "correct the scan distortion, or average faster scans"),
    # unspoilt series have up to 0.7, and 2.7 standard errors
    Row("axis of single rows", "lines", "distortion",
        lambda case: uneven_axis(case.integrals, case.residuals.tilt_angles), "pixels", 0.7,
        "the tilt axis is not straight: single rows are displaced by {value:.1f} pixels in all images",
        "correct the scan distortion, such as the delay of every second line"),
    Row("filled borders", "lines", "fact", _pixel(pixels.borders), "of the images", TILTS,
        "{value:.0%} of the images have borders with a constant value", "mask these borders with --mask FILE", local=True),
    # standard deviations of all pixels, at most 0.26 in correct series; typical steps
    Row("steps between columns", "pattern", "fact", _pixel(pixels.seam), "of the contrast", 0.35,
        "all images have a step between columns {what}, as at the border of two parts of a detector", FLATS, score=12.0,
        local=True),
    # relative to the mean, to which an object within the volume does not rise at its faces; sections that fill it reach 0.85
    Row("faces of the volume", "thickness", "fact", cases.cut_off, "", 1.0,
        "the volume is {value:.1f} times as dense at its top or bottom as on average: the object extends beyond it",
        "remove --thickness, or give a larger value", local=True),
    Row("magnification of the halves", "magnification", "fact", lambda case: sharpness.magnified(case.integrals),
        "of correlation", 0.1, "the second half of the tilts shows the specimen {what} times as large as the first",
        "rescale all images to one pixel size"),
    # a fact of the fit, which explains residuals
    Row("convergence", "convergence", "fact", cases.unconverged, "of the structure", cases.tolerable_convergence,
        "the volume leaves {value:.0%} more of the structure of its images than a linear fit of images that it has not seen",
        "use more iterations (--steps), or a smaller --weight"),
    Row("contrast", "mode", "distortion", cases.inverted, "of the images", MARGIN,
        "the contrast looks inverted: as given and inverted, a volume explains {what}",
        "give the other --mode, or --invert-contrast"),
)

DISTORTIONS: tuple[Row, ...] = (
    Row("visible object", "noise", "distortion", lambda case: Effect(10.0 * (case.geometry.structure < VISIBLE)), "", 1.0,
        "neighbouring pixels of the images are not correlated: no object is visible",
        "use a longer exposure, or check the file"),
    Row("tilts unlike the others", "tilts", "distortion", lambda case: tilts.foreign(case.coarse, case.geometry.errors),
        "of the tilts", TILTS, "{value:.0%} of the tilts hardly resemble the prediction from the others ({what} …)",
        "check these images and their angles, or exclude them"),
    Row("excluded tilts", "tilts", "distortion", cases.screened(lambda screening: screening.bad.mean()), "of the tilts", TILTS,
        "{value:.0%} of the tilts were excluded because they do not fit the others",
        "align the series, or check the list of angles"),
    # relative; the fit follows a smaller drift exactly
    Row("drift of the beam", "beam", "distortion", cases.screened(attrgetter("drift")), "", 0.2,
        "the beam changes by {value:.0%} from tilt to tilt", BEAM, local=True),
    Row("tilt axis", "axis", "distortion", lambda case: case.moments.direction, "°", DEGREES,
        "the tilt axis is rotated by {what}° in the images", AXIS),
    Row("turn of the axis", "axis", "distortion", lambda case: case.moments.turn, "°", TURN,
        "the tilt axis turns by {what}° in the images from the first tilt to the last", AXIS),
    Row("axis across", "axis", "distortion", lambda case: case.other_geometries.transposed(), "of the error", GAIN,
        "images turned by 90° explain each other better: the error of held-out tilts decreases by {value:.0%}", AXIS, score=2.5),
    Row("axis off the middle", "alignment", "distortion", lambda case: case.moments.offset, "pixels", coarse_pixels(OFF_AXIS),
        "the tilt axis is {what} pixels off the middle of the images", ALIGN),
    Row("moments and angles", "angles", "distortion", lambda case: case.moments.scale, "", SCALE,
        "the moments of the images require tilt angles that differ by {value:+.0%}", ANGLES),
    # smaller angles make any object smoother: 60 independent correct series gain at most 0.1, usually nothing
    Row("scale of the angles", "angles", "distortion", lambda case: case.other_geometries.angles(), "of the error", GAIN,
        "tilt angles {what} explain held-out tilts better: their error decreases by {value:.0%}", ANGLES, score=2.5, null=0.05),
    Row("order of the tilts", "angles", "distortion", lambda case: case.other_geometries.reordered(), "of the error", GAIN,
        "in another order, the images explain each other better: the error of held-out tilts decreases by {value:.0%}",
        ANGLES, score=2.5),
    Row("one object", "specimen", "distortion", lambda case: case.other_geometries.two_objects(), "of the error", GAIN,
        "two parts of the series contradict each other ({what}): each alone is explained better, by {value:.0%}",
        "reconstruct the parts separately; the specimen moved or changed between them", score=2.5),
    Row("other tilt axes", "axis", "distortion", lambda case: result.other_axis(case.alignment), "", 1.0,
        "another tilt axis explains the images nearly as well, {what} standard errors behind",
        "give the direction with --tilt-axis", local=True),
    # of the size: moves the edge of a specimen of 48 pixels by a third of a pixel; the shape is right
    Row("size of the specimen", "specimen", "distortion", cases.changing_size, "of the size", 0.03,
        "the specimen changes its size by {value:+.1%} over the series ({what} order)",
        "give --refine-alignment, which corrects it, or use the tilts that were taken first", local=True),
    *_of_images("shift across", ("shifts across the axis", "drift across the axis"), "alignment", "pixels",
                (coarse_pixels(SHIFT), coarse_pixels(SMOOTH_SHIFT)), ALIGN),
    *_of_images("shift along y", ("shifts along the axis", "drift along the axis"), "alignment", "pixels",
                (coarse_pixels(SHIFT), coarse_pixels(SMOOTH_SHIFT)), ALIGN),
    *_of_images("rotation", ("rotation of each image", "drift of the rotation"), "axis", "pixels at the edge",
                (coarse_pixels(2 * SHIFT), coarse_pixels(2 * SMOOTH_SHIFT)), AXIS),
    *_of_images("magnification", ("magnification of each image", "drift of the magnification"), "geometry",
                "pixels at the edge", (coarse_pixels(2 * SHIFT), coarse_pixels(2 * SMOOTH_SHIFT)),
                "check the angle file, --tilt-axis and the specimen, or use --refine-alignment"),
    *_of_images("tilt angle", ("each angle",), "geometry", "pixels at the edge", (coarse_pixels(2 * SHIFT),), ANGLES),
    *_of_images("brightness", ("brightness of each image", "drift of the brightness"), "beam", "of the contrast",
                (BRIGHTNESS, BRIGHTNESS), BEAM),
    *_of_images("background", ("background of each image", "drift of the background"), "beam", "of the contrast",
                (BRIGHTNESS, BRIGHTNESS), BEAM),
    # correct series have at most 0.09 where noise is weak; squares of noise leave more
    Row("response", "response", "distortion",
        lambda case: positive(case.moments.response), "of the signal",
        lambda case: 0.15 * (1 + 2 * case.noise),
        "the response is not linear: it loses {value:.0%} of the signal at the strongest contrast",
        "give images with a linear response (gamma 1, not saturated), and check --mode", score=2.5),
    # pixels² towards 90°; 2.8 errors have a probability of 1 in 400 by chance
    Row("blur that grows with the tilt", "resolution", "distortion",
        lambda case: sharpness.growing_blur(case.integrals, case.residuals.tilt_angles), "pixels²", 2.5,
        "the blur of the images grows with their tilt, by a variance of {value:.1f} pixels² towards 90°",
        "exclude the blurred tilts, or blur all tilts equally", score=2.8, local=True),
    # correct series lose up to 0.68
    Row("focus", "resolution", "distortion",
        lambda case: sharpness.focus_step(case.integrals, case.residuals.tilt_angles), "of the fine structure", 0.75,
        "between {what} the fine structure changes by {value:.0%}: tilts on one side are out of focus",
        "exclude the blurred tilts, or blur all tilts equally", local=True),
    # line integral at the sides relative to the mean
    Row("field of view", "field", "distortion", cases.beyond_the_sides, "of the mean signal", cases.FIELD,
        "the object extends beyond the sides of the images, with {value:.0%} of the mean signal there",
        "use a larger field of view, or a smaller object"),
    Row("fixed pattern", "pattern", "distortion", _pixel(pixels.pattern), "of the contrast", 0.02,
        "the residuals contain a fixed detector pattern of {value:.1%} of the contrast", FLATS, local=True),
    # typical deviations beyond replicates; correct series have up to 4.5, and one standard error
    Row("single tilts", "tilts", "distortion", lambda case: cases.of_tilts(tilts.single, case, case.geometry.single_errors), "",
        5.0, "the image at {what} is inconsistent with its neighbours: it belongs to another tilt or another object",
        "check its angle, or exclude it", score=2.5, local=True),
    # correct series have 0.42
    Row("break of the series", "specimen", "distortion", lambda case: tilts.broken(case.coarse), "of the structure", 0.5,
        "the images {what} do not match at the border: the specimen changed",
        "reconstruct both parts separately, or check whether one of them was flipped", local=True),
    # shifted objects have at most 0.6
    Row("moving background", "beam", "distortion",
        lambda case: pixels.moving_background(case.residuals) if _left(case) else Effect(0.0), "of the residuals", 0.65,
        "{value:.0%} of the structure common to the residuals is smooth and differs between tilts: the background moves",
        "subtract the background of each image first", local=True),
)

PREDICTIVE: tuple[Row, ...] = (
    # relative to the change between surrounding tilts, 0.9 in correct series
    Row("changes between tilts", "angles", "predictive", lambda case: cases.of_tilts(tilts.jumps, case), "", 3.0,
        "between {what} the images change {value:.0f} times as much as between the tilts around: angles are in the wrong order "
        "there, or the specimen moved", "check the list of angles and the images of these tilts", local=True),
    # nats per pixel; final steps normally change it by some thousandths
    Row("course of the fit", "fit", "predictive", lambda case: result.jump(getattr(case.result, "fit_result", None)),
        "nats", 0.1, "the held-out likelihood at the end was {value:.2g} nats per pixel worse than before",
        "compare with --method l2 or sirt, and report this series"),
    Row("weight of the regulariser", "weight", "predictive",
        lambda case: result.weight_at_end(getattr(case.result, "weights_tried", None) or {}), "", 0.5,
        "held-out pixels prefer a weight of the regulariser {what}",
        "compare with --method l2, and align the series", local=True),
    Row("structure of the residuals", "residuals", "predictive", cases.left_in_residuals, "of the structure",
        RESIDUAL, "no volume explains {value:.1%} of the structure of the images",
        "look for the moving part in the residuals of the report"),
    Row("moments of the rows", "consistency", "predictive", lambda case: case.moments.power, "of the moments", 0.006,
        "{value:.1%} of the structure of the moments of the rows is none that an object can have",
        "check axis, shifts and angles of the series, and whether the specimen changed"),
    Row("held-out gaps of tilts", "consistency", "predictive", cases.inconsistent, "of the structure", cases.tolerable,
        "{value:.0%} of the structure of held-out gaps of tilts is not explained by the others",
        "check axis, shifts and angles of the series"),
    # error of the explained share: above it, the other checks cannot detect defects
    Row("noise", "noise", "predictive", lambda case: Effect(case.error_of_gaps), "of the structure", 0.1,
        "noise limits the test: the explained share of held-out tilts has an error of ±{value:.0%}",
        "average exposures, or bin the images", local=True),
)

# fmt: on


def _left(case: Case) -> bool:
    return cases.left_in_residuals(case).value > RESIDUAL


CHECKS: dict[str, Row] = {row.name: row for row in (*FACTS, *DISTORTIONS, *PREDICTIVE)}
"""All checks by name."""
