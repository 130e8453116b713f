"""The checks of a reconstruction, one row each: what is measured, what is tolerated, and what to do."""

from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import numpy as np

from noiseflow.checks import LIKELY, MOST, SIGNIFICANT, Check, Effect, Engine, NotTested
from noiseflow.statistics import Array, rarely_exceeded
from recon.series.masks import without_spikes
from recon.series.tilt_series import as_if_in_radians
from recon.series.views import HARMLESS
from recon.verdict import case as cases
from recon.verdict import compared, moments, pixels, sharpness, tilts
from recon.verdict.case import Case
from recon.verdict.distortions import displaced_lines
from recon.verdict.geometry import REPLICATES, positive

TOLERANCES: dict[str, float] = {
    # ratios, of which each row says of what
    "": 1.0,
    # moves the edge of 64 pixels by half a pixel
    "°": 1.0,
    # from end to end of the series, where few tilts determine it: unspoilt series have up to 4
    "turn of the axis": 6.0,
    # half of the directions; three tilts of a coarse series
    "° without tilts": 90.0,
    "gap inside the range": 15.0,
    # beads have as much with 17 directions of 180°, cubes with 10
    "number of tilts": 0.1,
    # a quarter of a coarse pixel, of which the field of view has about thirty, and a hundredth of that field for the axis
    "pixels": 0.25,
    "axis off the middle": 0.3,
    # detector pixels, along lines; unspoilt series have up to 0.2
    "pixels rms": 0.4,
    # towards 90°: a blur by a pixel and a half, beside that of the pixels; unspoilt series lose up to 0.71
    "pixels²": 2.5,
    "of the fine structure": 0.75,
    "of the size": HARMLESS["size"],
    # moves the edge of the tilt range by 4°
    "of the angles": 0.06,
    # brightness and background of single images, to which the regression is coarse
    "of the contrast": 0.18,
    # and where noise is weak: unspoilt series have at most 0.07, and 0.09 of the signal
    "uneven background": 0.1,
    "of the signal": 0.15,
    # of all images: unspoilt series have at most 0.08; a gradient that is ten percent of the beam, 0.15 and more
    "uneven illumination": 0.12,
    # patterns are seen by fine structure, and steps against the deviation of all pixels, where objects have up to 0.26
    "stuck pixels": 0.02,
    "fixed pattern": 0.02,
    "steps between columns": 0.35,
    # from tilt to tilt, which a fit follows, and from the first tilt to the last: a specimen that changed so much is another one
    "of the beam": 0.2,
    "trend of the beam": 0.15,
    # of the vacuum: the mass of the volume is then a seventh too small; series without a dark level have up to 0.06
    "dark level": 0.12,
    # of neighbouring rows; unspoilt series leave at most 0.009 beyond replicates
    "of the structure": 0.012,
    "images of one direction": 0.03,
    "of the moments": 0.006,
    # share of the error of held-out tilts; unspoilt series gain at most 0.05
    "of the error": 0.06,
    # turned images are interpolated: unspoilt series of two counts gain up to 0.13
    "axis elsewhere": 0.15,
    # exceptions: one in five hundred pixels is harmless, and one in ten tilts; detectors with strong tails have 0.00003 spikes
    "of the pixels": 0.002,
    "spikes": 0.0001,
    "pixels at a limit": 0.004,
    "end of the pixel values": 12.0,
    "of the tilts": 0.1,
    # facts, whichever their size
    "repeated images": 0.0,
    # one or none: last of the facts
    "images scaled one by one": 0.9,
    "weight of the regulariser": 0.0,
    # objects that fill the field reach 0.85 at the faces of the volume, and less at the sides of the images
    "of the mean signal": HARMLESS["sides"],
    "of the images": HARMLESS["contrast"],
    # a section becomes thicker when it is tilted: sections and films have up to 0.84, and 1 has a wire along the rows
    "of common structure": 0.95,
    # a fifth moves the mass by a sixth; rows with offsets of their own leave up to 0.04
    "level of the vacuum": 0.1,
    # bright field has at most 0.3, and inverted dark field 0.8 and more
    "of the change": 0.5,
    "of correlation": 0.1,
    # beyond replicates, of which thin shells have as much as they themselves
    "of broken structure": 0.5,
    # typical deviations beyond replicates; unspoilt series have up to 4.5, and one standard error
    "single tilts": 5.0,
    # relative to the change between surrounding tilts, 0.9 in unspoilt series
    "changes between tilts": 3.0,
    # of the held-out likelihood; final steps normally change it by some thousandths
    "nats": 0.1,
}
"""Largest harmless deviation by unit, or by name of the row where it differs from that of its unit."""
ALIGN = "align the series first, or use --refine-alignment"
AXIS = "give --tilt-axis, or use --refine-alignment"
ANGLES = "check the list of tilt angles, its order and its signs"
FLATS = "correct the images with flats and darks first"
MASK = "mask them with --mask FILE, or exclude these images"
BEAM = "normalise the images by their incident beam, or check the mode"
_RARE, _RARER = (rarely_exceeded(score, REPLICATES - 1) for score in (LIKELY, SIGNIFICANT))


def _in_radians(case: Case) -> Effect:
    angles = case.series.tilt_angles
    return Effect(MOST * as_if_in_radians(angles), what=f"{np.ptp(angles):.2f}")


def _gaps(case: Case) -> Array:
    """The widths of the ranges of directions without tilts, degrees, widest first."""
    if _in_radians(case).value:
        raise NotTested("the angles are in radians")
    return tilts.gaps_between(case.series.tilt_angles)


def _inner_gap(case: Case) -> Effect:
    gaps = _gaps(case)
    return Effect(max(gaps[1:], default=0.0) if gaps[1:2].sum() > 2 * np.median(gaps) else 0.0)


def _vacuum(case: Case) -> Effect:
    return compared.above_vacuum(case.series, case.whole.residuals)[-1]


def _jitter(distortion: str, case: Case) -> Effect:
    return case.distortions[distortion].jitter


def _row(
    engine: Engine,
    name: str,
    reason: str,
    measure: Callable[[Case], Effect],
    unit: str,
    sentence: str,
    advice: str,
    tolerance: Callable[[Case], float] | None = None,
    **more: Any,
) -> Check[Case]:
    """A check with the tolerance of its name or its unit, or one that depends on the case."""
    given: Any = tolerance or TOLERANCES.get(name, TOLERANCES.get(unit))
    # coarse pixels, about a thirtieth of the field of view, which held-out tilts resolve in any image
    known = (lambda case: given * case.coarse.binning) if unit == "pixels" else given
    return Check(name, reason, engine, measure, unit, known, sentence, advice, **more)


fact, distortion, predictive = (partial(_row, engine) for engine in get_args(Engine))


# fmt: off
ROWS: tuple[Check[Case], ...] = (
    fact("angles in radians", "angles", _in_radians, "",
         "the tilt angles span {what}°, as if they were radians", "give the tilt angles in degrees"),
    fact("missing wedge", "range", lambda case: Effect(_gaps(case)[0]), "° without tilts",
         "{value:.0f}° of 180° have no tilts, so most directions of the volume are not measured",
         "add tilts, or trust only structures that face the beam", local=True),
    fact("gap inside the range", "range", _inner_gap, "° without tilts",
         "the tilts leave a gap of {value:.0f}° inside their range",
         "add tilts there, or expect streaks in these directions", local=True),
    fact("number of tilts", "range", cases.between_tilts, "of the structure",
         "{what} directions are too few for fine detail", "take more tilts", local=True),
    fact("repeated images", "repeats", lambda case: tilts.repeated(case.series), "of the tilts",
         "{value:.0%} of the images are exact copies of another image", "remove the copies", local=True),
    fact("images scaled one by one", "beam", lambda case: tilts.normalised(case.series), "",
         "every image has the same mean and deviation, or the same range: each was scaled by itself",
         "give the images as recorded", local=True),
    fact("images of one direction", "angles", lambda case: tilts.twins(case.coarse), "of the structure",
         "images of the same direction differ by {value:.0%} of their structure", ANGLES),
    fact("pixels at a limit", "saturation",
         lambda case: pixels.piled(case.residuals, "high" if case.series.mode == "linear" else "low"), "of the pixels",
         "{value:.1%} of the pixels are at the limit of strong contrast, {what}, more than just inside it",
         "use a series that is not saturated, or mask these parts", local=True),
    fact("end of the pixel values", "saturation", lambda case: pixels.cliff(case.residuals), "",
         "the pixel values end abruptly at {what}, as if brighter ones had wrapped around or been removed",
         "check the data type in which the images were saved", local=True),
    fact("spikes", "outliers",
         lambda case: Effect(float((case.series.used != without_spikes(case.series).used).mean())), "of the pixels",
         "{value:.2%} of the pixels deviate from the others by more than 5 times their range",
         "mask the spikes with --mask FILE, or replace them", local=True),
    fact("dead pixels", "lines", lambda case: Effect(float(pixels.dead_pixels(case.residuals).mean())),
         "of the pixels",
         "{value:.1%} of the pixels have a constant value in all tilts, unlike those around them", MASK, local=True),
    fact("stuck pixels", "lines", lambda case: pixels.stuck(case.residuals, case.rows), "of the contrast",
         "single pixels differ from those around them in all tilts, by {value:.1%} of the contrast: {what}", MASK,
         local=True),
    fact("streaks", "lines", lambda case: pixels.streaks(case.residuals), "of the pixels",
         "{value:.1%} of the {what} of single images differ from their neighbours", MASK, local=True),
    fact("filled borders", "lines", lambda case: pixels.borders(case.residuals), "of the tilts",
         "{value:.0%} of the images have borders with a constant value", "mask these borders with --mask FILE", local=True),
    distortion("displaced lines", "lines", lambda case: displaced_lines(case.residuals), "pixels rms",
         "the lines of the images are displaced along themselves, by {value:.1f} pixels",
         "correct the scan distortion, or average faster scans"),
    fact("steps between columns", "pattern", lambda case: pixels.seam(case.residuals), "of the contrast",
         "all images have a step between columns {what}, as of a faulty column or at the border of two parts of a detector",
         FLATS, local=True),
    fact("gain of the halves", "pattern", lambda case: pixels.halves(case.integrals), "of the signal",
         "the halves of all images differ in gain by {value:.0%}, from columns {what}", FLATS, score=LIKELY, local=True),
    distortion("uneven illumination", "pattern", cases.uneven_illumination, "of the contrast",
         "the background of all images is uneven in the same way, by {value:.0%} of the contrast", FLATS),
    fact("level of the vacuum", "beam", _vacuum, "of the mean signal",
         "the vacuum has another level in each image, by {value:.0%} of the mean signal",
         "subtract it from each image, or divide bright field by it", local=True),
    fact("faces of the volume", "thickness", cases.cut_off, "",
         "the volume is {value:.1f} times as dense at its top or bottom as on average: the object extends beyond it",
         "remove --thickness, or give a larger value", local=True),
    fact("magnification of the halves", "magnification", lambda case: sharpness.magnified(case.whole.integrals),
         "of correlation", "the second half of the tilts shows the specimen {what} times as large as the first",
         "rescale all images to one pixel size"),
    fact("images that do not change", "angles", cases.still, "",
         "the images hardly change with the tilt, although they are not symmetric: the stage did not move",
         "check how the images were taken"),
    # a fact of the fit, which explains residuals
    fact("convergence", "convergence", cases.unconverged, "of the structure",
         "the volume leaves {value:.0%} more of the structure of its images than a linear fit of images that it has not seen",
         "use more iterations (--steps), or a smaller --weight", tolerance=cases.tolerable_convergence),
    distortion("contrast", "mode", cases.inverted, "of the images",
         "the contrast looks inverted: as given and inverted, a volume explains {what}",
         "give the other --mode, or --invert-contrast"),
    distortion("inverted dark field", "mode",
         lambda case: moments.as_of_dark_field(case.series, case.whole.residuals, case.fitted), "of the change",
         "the mass of the images changes over the tilts as if this bright field were inverted dark field ({value:.0%} of the "
         "change), or stretched", "give --invert-contrast --mode linear for dark field, or values that are 0 without a beam"),
    distortion("dark level", "response", lambda case: pixels.dark_level(case.series.mode, case.residuals), "of the beam",
         "the noise of the images vanishes at a pixel value of {what}, not at 0, as if the dark level were not subtracted",
         "subtract the dark level, of at least this value, from all images, or use images that are not stretched",
         local=True),
    distortion("visible object", "noise", lambda case: Effect(MOST * (case.geometry.structure < cases.VISIBLE)), "",
         "neighbouring pixels of the images are not correlated: no object is visible",
         "use a longer exposure, or check the file"),
    distortion("tilts unlike the others", "tilts", lambda case: tilts.foreign(case.coarse, case.geometry.errors),
         "of the tilts", "{value:.0%} of the tilts hardly resemble the prediction from the others ({what} …)",
         "check these images and their angles, or exclude them"),
    # the fit follows both exactly; a steady change may be one of the specimen
    distortion("drift of the beam", "beam", lambda case: Effect(case.screened.drift), "of the beam",
         "the beam changes by {value:.0%} from tilt to tilt", BEAM, local=True),
    distortion("trend of the beam", "beam", cases.trend, "of the beam",
         "the brightness changes by {value:+.0%} from the first tilt to the last: the beam drifts, or the specimen gains or "
         "loses material", "check the specimen for contamination and damage, or use the tilts that were taken first", local=True),
    distortion("tilt axis", "axis", cases.direction_of_axis, "°",
         "the tilt axis is rotated by {value:+.1f}° in the images, to --tilt-axis {what}",
         "give that, or use --refine-alignment"),
    distortion("equal images", "axis", cases.alike, "of common structure",
         "the object goes on beside the images, which hardly change: the tilt axis seems to run along the rows", AXIS),
    distortion("turn of the axis", "axis", lambda case: case.moments.turn, "°",
         "the tilt axis turns by {value:+.1f}° in the images from the first tilt to the last",
         "turn each image by its part, or give --alignment with a rotation of each"),
    distortion("axis elsewhere", "axis", lambda case: case.other_geometries.turned, "of the error",
         "images turned by {what}° explain each other better: the error of held-out tilts decreases by {value:.0%}", AXIS,
         score=LIKELY),
    distortion("axis off the middle", "alignment", lambda case: case.moments.offset, "pixels",
         "the tilt axis is {what} pixels off the middle of the images", ALIGN),
    distortion("scale of the angles", "angles", cases.other_scale, "of the angles",
         "the sums of the rows of the images require tilt angles that differ by {value:+.0%}", ANGLES),
    distortion("order of the tilts", "angles", lambda case: case.other_geometries.reordered(), "of the error",
         "in another order, the images explain each other better: the error of held-out tilts decreases by {value:.0%}",
         ANGLES, score=LIKELY),
    distortion("one object", "specimen", lambda case: case.other_geometries.two_objects(), "of the error",
         "two parts of the series contradict each other ({what}): each alone is explained better, by {value:.0%}",
         "reconstruct the parts separately; the specimen moved or changed between them", score=LIKELY),
    distortion("other tilt axes", "axis", lambda case: compared.other_axis(case.alignment), "",
         "another tilt axis explains the images nearly as well, {what} standard errors behind",
         "give the direction with --tilt-axis", local=True),
    distortion("size of the specimen", "specimen", cases.changing_size, "of the size",
         "the specimen changes its size by {value:+.1%} over the series ({what} order)",
         "give --refine-alignment, which corrects it, or use the tilts that were taken first", local=True),
    *(
        distortion(f"shifts {way} the axis", "alignment", partial(_jitter, of), "pixels",
             f"{of}: the images differ from what the others predict, by {{value:.2f}} pixels", ALIGN)
        for way, of in (("across", "shift across"), ("along", "shift along y"))
    ),
    distortion("uneven background", "beam", partial(_jitter, "uneven background"), "of the contrast",
         "the background of single images is uneven, by {value:.0%} of the contrast",
         "subtract a smooth background from each image, or correct its illumination",
         tolerance=cases.with_noise(TOLERANCES["uneven background"])),
    distortion("response", "response", lambda case: positive(case.moments.response), "of the signal",
         "the response is not linear: it loses {value:.0%} of the signal at the strongest contrast",
         "give images with a linear response (gamma 1, not saturated), and check --mode",
         tolerance=cases.with_noise(TOLERANCES["of the signal"]), score=LIKELY),
    distortion("blur that grows with the tilt", "resolution",
         lambda case: sharpness.growing_blur(case.whole.integrals, case.residuals.tilt_angles), "pixels²",
         "the blur of the images grows with their tilt, by a variance of {value:.1f} pixels² towards 90°",
         "exclude the blurred tilts, or blur all tilts equally", score=LIKELY, local=True),
    distortion("focus", "resolution",
         lambda case: sharpness.focus_step(case.integrals, case.residuals.tilt_angles), "of the fine structure",
         "between {what} the fine structure changes by {value:.0%}: tilts on one side are out of focus",
         "exclude the blurred tilts, or blur all tilts equally", local=True),
    distortion("break of the series", "specimen", lambda case: cases.of_tilts(tilts.broken, case), "of broken structure",
         "the images {what} do not match at the border: the specimen changed",
         "reconstruct both parts separately, or check whether one of them was flipped", score=_RARER, local=True),
    distortion("single tilts", "tilts", cases.unlike_neighbours, "",
         "the image at {what} is inconsistent with its neighbours: it belongs to another tilt or another object",
         "check its angle, or exclude it", score=LIKELY, local=True),
    distortion("field of view", "field", cases.beyond_the_sides, "of the mean signal",
         "the object extends beyond the sides of the images, with {value:.0%} of the mean signal there",
         "use a larger field of view, or the joint method, whose volume goes on beside the images"),
    distortion("fixed pattern", "pattern", lambda case: pixels.pattern(case.residuals), "of the contrast",
         "the residuals contain a fixed detector pattern of {value:.1%} of the contrast", FLATS, local=True),
    predictive("unexplained pixels", "lines", lambda case: pixels.unexplained(case.residuals, case.rows), "of the pixels",
         "no volume explains what {value:.1%} of the pixels show in all tilts, in {what}", MASK, local=True),
    predictive("changes between tilts", "angles", lambda case: cases.of_tilts(tilts.jumps, case), "",
         "between {what} the images change {value:.0f} times as much as between the tilts around: angles are in the wrong "
         "order there, or the specimen moved", "check the list of angles and the images of these tilts",
         score=_RARE, local=True),
    predictive("course of the fit", "fit", lambda case: compared.jump(getattr(case.result, "fit_result", None)), "nats",
         "the held-out likelihood at the end was {value:.2g} nats per pixel worse than before",
         "compare with --method l2 or sirt, and report this series"),
    predictive("weight of the regulariser", "weight",
         lambda case: compared.weight_at_end(getattr(case.result, "weights_tried", None) or {}), "",
         "held-out pixels prefer a weight of the regulariser {what}",
         "compare with --method l2, and align the series", local=True),
    predictive("structure of the residuals", "residuals", cases.left_in_residuals, "of the structure",
         "no volume explains {value:.1%} of the structure of the images",
         "look for the moving part in the residuals of the report", score=_RARER),
    predictive("moments of the rows", "consistency", lambda case: positive(case.moments.power), "of the moments",
         "{value:.1%} of the structure of the moments of the rows is none that an object can have",
         "check axis, shifts and angles of the series, and whether the specimen changed"),
    predictive("held-out gaps of tilts", "consistency", cases.inconsistent, "of the structure",
         "{value:.0%} of the structure of held-out gaps of tilts is not explained by the others",
         "check axis, shifts and angles of the series", tolerance=cases.tolerable, score=_RARER),
)

# fmt: on
CHECKS: dict[str, Check[Case]] = {row.name: row for row in ROWS}
"""All checks by name."""
