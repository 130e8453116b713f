"""Statistics of pixel values: limits, dead and filled parts, spikes, steps, and fixed detector patterns."""

import numpy as np
from scipy import ndimage

from noiseflow.checks import LIKELY, SIGNIFICANT, Effect, NotTested
from noiseflow.statistics import Array, robust_deviation, weighted_line, white_regression
from recon.series.first_guess import LEAST_SHARE
from recon.series.tilt_series import Mode
from recon.series.views import AROUND
from recon.verdict.compared import Residuals, neighbours

# of the range of the values: a smaller step to the surroundings may belong to the object
_STEP = 0.1
# probability of a line, or of a pixel in all tilts, of equal counts
_CHANCE = 1e-3
# residuals of a pixel over the tilts, a row and a column relative to the usual at their signal; unspoilt series with long tails
# reach 3.1, 1.8 and 1.5
_LARGER: dict[tuple[int, ...], float] = {(0,): 3.5, (0, 2): 2.0, (0, 1): 2.0}
# of the pixels of a row or column: fewer that deviate are single pixels, and of as many the line itself is at fault
_OF_LINE = 0.25
# of the noise: detail that adds at most a third to its variance; with a third of that, few pixels at edges are left
_DETAIL = 0.55


def piled(residuals: Residuals, end: str) -> Effect:
    """Share of pixels at a limit, if they are more than just inside it: noise around a limit leaves at least half inside."""
    images = residuals.images[:, ~dead_pixels(residuals)]
    limit = float(images.min() if end == "low" else images.max())
    away = np.abs(images - np.float32(limit))
    near = away <= max(0.05 * _span(images), float(away[away > 0].min(initial=np.inf)))
    at = away == 0
    return Effect(float(at.mean()) if at.sum() > 0.6 * near.sum() else 0.0, what=f"{limit:.4g}")


def cliff(residuals: Residuals, *, fewest_values: int = 60) -> Effect:
    """Ratio of pixels just below the brightest values to those above, at least: brighter values wrapped around or were removed.

    Fewer values are no histogram. Counts of either are uncertain by their square roots. Noise, four bins wide, smears every edge
    in the histogram of the object.
    """
    images, width = residuals.images, 0.25 * robust_deviation(residuals.residual)
    values, counts = np.unique(images, return_counts=True)
    if not np.median(np.diff(values[-fewest_values:])) < width / 2:
        raise NotTested("the histogram has too few values")
    total = np.append(0, np.cumsum(counts))
    # steps in the middle belong to the object
    first = min(int(np.searchsorted(total, 0.9 * images.size)), len(values) - 1)
    tops, here = values[first:], total[first + 1 :]
    below = here - total[np.searchsorted(values, tops - width)]
    above = total[np.searchsorted(values, tops + width, "right")] - here
    countable = counts[first:] < 0.5 * below  # more at one value are clipped
    fewest, most = below - SIGNIFICANT * np.sqrt(below), above + SIGNIFICANT * np.sqrt(np.maximum(above, 1))
    ratios = np.where(countable, fewest / most, 0.0)
    largest = int(np.argmax(ratios))
    return Effect(float(ratios[largest]), what=f"{float(tops[largest]):.4g}")


def dead_pixels(residuals: Residuals, *, fewest: float = 0.01) -> Array:
    """(y, u) whether a pixel has a constant value in all tilts. At the ends of the values and at the most common one, perhaps of
    vacuum without noise, only those that differ from their surroundings and expectation count, or whose value no neighbour has,
    nor any other pixel a similar one."""
    images = residuals.images
    constant = (images.max(0) == images.min(0)) & residuals.used.any(0)
    if constant.all() or not constant.any():
        return np.zeros_like(constant)
    values, counts = np.unique(images[0][constant], return_counts=True)
    ends = float(images.min()), float(images.max())
    levels = [*ends, float(values[np.argmax(counts)])]
    dead = constant & ~np.isin(images[0], levels)
    span, mean, expected = _span(images), images.mean(0), residuals.projections.mean(0)
    for level in levels:
        regions, count = ndimage.label(constant & (images[0] == level))
        others = images[images != level]
        apart_from_all = float(np.quantile(np.abs(others - level), fewest)) > _STEP * _span(others)
        for number in range(1, count + 1):
            inside = regions == number
            around = ndimage.binary_dilation(inside) & ~inside
            alike = float((images[:, around] == level).mean())
            if alike ** (len(images) * int(inside.sum())) * mean.size > _CHANCE:  # counts that are mostly zero
                continue
            apart = min(abs(float(np.median(each)) - level) for each in (mean[around], expected[inside])) > _STEP * span
            if apart or (alike == 0 and (level not in ends or apart_from_all)):
                dead |= inside
    return np.asarray(dead)


def streaks(residuals: Residuals) -> Effect:
    """Share of rows or columns of single images whose mean residual differs from their neighbours by as much as the
    projections vary, and by eight typical deviations: by chance, four in thousands of lines do."""
    shares = {}
    for name, axis in (("rows", 2), ("columns", 1)):
        means = residuals.residual.mean(axis)
        near = {"size": (1, 5), "mode": "nearest"}
        apart = np.abs(means - ndimage.median_filter(means, **near))
        # where counts are few, most lines are empty, and those beside them scatter by more than is usual
        scatter = ndimage.maximum_filter(residuals.residual.std(axis), **near) / residuals.residual.shape[axis] ** 0.5
        least = np.maximum(2 * SIGNIFICANT * np.maximum(robust_deviation(apart, 0.0), scatter), residuals.contrast)
        shares[name] = float((apart > least).mean())
    worst = max(shares, key=lambda name: shares[name])
    return Effect(shares[worst], what=worst)


def unexplained(residuals: Residuals, rows: slice) -> Effect:
    """Share of pixels that, alone or as rows or columns, have larger residuals than others at their signal, which are most of
    their structure. Lines that are constant in an image, as an alignment fills them, are not judged. The residuals are of some
    of these rows of the whole images."""
    if len(residuals.images) < AROUND:  # a volume of few tilts explains anything
        raise NotTested(f"needs {AROUND} tilts")
    if not residuals.contrast > 0:
        raise NotTested("the volume shows no structure")
    shown = residuals.images[np.ptp(residuals.images, (1, 2)) > 0]
    flat_rows, flat_columns = ((np.ptp(shown, axis) == 0).any(0) for axis in (2, 1))
    judged = residuals.used & ~(flat_rows[:, None] | flat_columns)
    if not residuals.residual[judged].any():
        return Effect(0.0)
    known, means = judged.copy(), residuals.images.mean((0, 2), keepdims=True)
    structure = np.maximum((residuals.images - means) ** 2, 2 * (_STEP * residuals.contrast) ** 2)
    relative = _relative_to_rows(residuals)
    for axes, larger in _LARGER.items():
        count = np.maximum(known.sum(axes, keepdims=True), 1)
        parts = relative, residuals.residual**2, structure
        size, left, whole = ((each * known).sum(axes, keepdims=True) / count for each in parts)
        usual = np.median(size[size > 0])  # without pixels that saw no electron
        known &= (size <= larger * usual) | (left < whole / 2)
    found = (judged & ~known).any(0)
    if not found.any():
        return Effect(0.0)
    y, x = np.nonzero(found)
    y = y + _first_row(residuals, rows)
    return Effect(float(found.mean()), what=f"rows {y.min()} to {y.max()}, columns {x.min()} to {x.max()}")


def _relative_to_rows(residuals: Residuals) -> Array:
    """(tilt, y, u) sizes of the residuals relative to those of most rows at the same signal, as far as they are significant."""
    known, sizes, height = residuals.used, np.abs(residuals.residual), len(residuals.height)
    levels = np.quantile(residuals.projections[known], np.linspace(0, 1, 9)[1:])
    group = np.searchsorted(levels[:-1], residuals.projections)
    place = (group * height + np.arange(height)[:, None])[known]
    sums, counts = (np.bincount(place, each, len(levels) * height) for each in (sizes[known], None))
    means = (sums / np.maximum(counts, 1)).reshape(-1, height)
    usual = np.array([np.median(each[each > 0]) if each.any() else np.inf for each in means])
    return np.asarray(np.minimum(sizes / usual[group], SIGNIFICANT))


def borders(residuals: Residuals) -> Effect:
    """Share of images with borders of a constant value, unlike the adjacent pixels, as left by an alignment.

    Empty borders without noise are no fault: there the volume predicts that value; rows have it in the other images, too, because
    tilting about y moves nothing to other rows.
    """
    seen, span = np.where(residuals.used, residuals.images, np.nan), _span(residuals.images)  # masked ones are filled
    flat = seen.max(2) == seen.min(2)
    usual = np.where(flat, 0, seen.mean(2)).sum(0) / np.where(flat.all(0), np.nan, (~flat).sum(0))
    rows = np.broadcast_to(usual[:, None], (*seen.shape[:2], 1))
    # (tilt, from the side, along it)
    sides = [each.transpose(0, 2, 1) for each in (seen, residuals.projections)], [seen, rows]
    filled = [_filled(lines[:, ::step], expected[:, ::step], span) for lines, expected in sides for step in (1, -1)]
    return Effect(float((np.mean(filled, axis=0) > 0).mean()))


def _filled(lines: Array, expected: Array, span: float) -> Array:
    """(tilt,) number of leading lines with a constant value that differs clearly from the next line, and that counts in an image
    mostly without electrons would not have by chance."""
    flat = (lines.max(2) == lines.min(2)) & (lines[:, :, 0] == lines[:, :1, 0])
    alike = (lines == lines[:, :1, :1]).mean((1, 2))  # of the pixels
    flat &= (alike ** lines.shape[2] < _CHANCE)[:, None]
    count = np.argmin(flat, axis=1)
    after = lines[np.arange(len(lines)), count].mean(1)
    unlike = np.abs(expected[:, 0].mean(1) - lines[:, 0, 0])
    return np.where(np.minimum(np.abs(after - lines[:, 0, 0]), 2 * unlike) > _STEP * span, count, 0)


def seam(residuals: Residuals, *, object_leaves: float = 0.1) -> Effect:
    """Largest step between two columns in the mean of all tilts, in which edges of the object are smeared out, unless it
    surrounds the axis: then there is the opposite step on the other side. Of the edge of a wire beside the axis, a volume leaves
    less than a tenth in the residuals; of a step of the detector, a fifth to a half. Steps of few rows are left out."""
    apart, left = (_steps(each) for each in (residuals.images, residuals.residual))
    apart = np.minimum(np.abs(apart), np.abs(apart + apart[::-1]))
    apart = np.minimum(apart, np.abs(left) / object_leaves - apart).clip(0)
    where, scale = int(np.argmax(apart)), max(float(residuals.images.std()), 1e-30)
    return Effect(float(apart[where]) / scale, 3 * robust_deviation(apart, 0.0) / scale, f"{where} and {where + 1}")


def _steps(images: Array) -> Array:
    """(column,) steps to the next column in the mean of (tilt, y, u) images, beside those around, without the extreme rows."""
    rows = np.sort(np.diff(images.mean(0, dtype=np.float64)), 0)
    few = int(_OF_LINE * len(rows))
    steps = rows[few : len(rows) - few].mean(0)
    return np.asarray(steps - ndimage.median_filter(steps, 5, mode="nearest"))


def halves(integrals: Array) -> Effect:
    """Step between the halves of line integrals (tilt, y, u) in the mean of all tilts, relative to their mean there; its error is
    the largest step elsewhere. A volume follows this step. No edge of an object stays at the tilt axis, but for wires as thin as
    a pixel, which leave as large a step beside it: 2 times as large at most, and 1.6 times in 450 unspoilt series."""
    apart, half = np.abs(_steps(integrals)), integrals.shape[2] // 2
    where = max(half - 1, integrals.shape[2] - 1 - half, key=lambda column: apart[column])
    mean = max(abs(float(integrals[:, :, where : where + 2].mean())), 1e-30)
    elsewhere = float(np.delete(apart, where).max(initial=0.0))
    return Effect(float(apart[where]) / mean, elsewhere / mean, f"{where} and {where + 1}")


def stuck(residuals: Residuals, rows: slice, *, named: int = 3) -> Effect:
    """Deviation of `_stuck` pixels, rms over the whole images relative to the contrast, and the places of the largest. The
    residuals are of some of these rows of the whole images."""
    alone = _stuck(residuals)
    largest, count = np.argsort(-np.abs(alone), axis=None)[:named], np.count_nonzero(alone)
    places = (np.unravel_index(place, alone.shape) for place in largest[:count])
    words = "; ".join(f"y {y + _first_row(residuals, rows)}, x {x}" for y, x in places)
    value = float(np.sqrt(np.mean(alone**2))) / max(residuals.contrast, 1e-30)
    return Effect(value, what=f"{words} …" if count > named else words)


def _stuck(residuals: Residuals, *, most: float = 0.9, around: int = 3) -> Array:
    """(y, u) deviation of single pixels from those around them in the mean of all tilts, zero of others. The image itself
    deviates, because a volume spreads what it takes from a pixel to those beside it, by more than `most` pixels do, and the
    residual in `most` tilts: what a volume leaves of the fine parts of an object has one sign in up to 0.89 of them."""
    means = (each.mean(0, dtype=np.float64) for each in (residuals.images, residuals.residual))
    shown, left = (each - ndimage.median_filter(each, around, mode="nearest") for each in means)
    found = np.minimum(np.abs(shown), np.abs(left)) > SIGNIFICANT * np.quantile(np.abs(left), most)
    found &= (np.sign(residuals.residual) == np.sign(left)).mean(0) > most
    lines = [found.mean(axis, keepdims=True) > _OF_LINE for axis in (0, 1)]
    return np.where(found & ~lines[0] & ~lines[1], left, 0.0)


def _first_row(residuals: Residuals, rows: slice) -> int:
    return int(residuals.height[0] + (rows.start + rows.stop - 1) / 2)


def pattern(residuals: Residuals) -> Effect:
    """Fine structure of the mean residual over the tilts beyond that of independent tilts, relative to the contrast.

    `_stuck` pixels do not count. Single-pixel gains have no correlation between neighbours; misfit at edges has 0.4 and more,
    beside what a volume that has not converged lacks of its fine structure.
    """
    both = np.where(_stuck(residuals) == 0, residuals.residual, 0), residuals.projections
    fine, own = (each - ndimage.uniform_filter(each, (0, 3, 3), mode="nearest") for each in both)
    share = (fine * own).sum((1, 2), keepdims=True) / np.maximum((own**2).sum((1, 2), keepdims=True), 1e-30)
    means = [each.mean(0, keepdims=True) for each in (fine, fine - share * own)]
    if any(neighbours(mean, axis) > 0.2 * np.var(mean) for mean in means for axis in (1, 2)):
        return Effect(0.0)
    steady, chance = float(np.var(means[0])), float(np.var(fine)) / len(fine)
    return Effect(np.sqrt(steady) / max(residuals.contrast, 1e-30) if steady > 1.6 * chance else 0.0)


def dark_level(mode: Mode, residuals: Residuals) -> Effect:
    """Signal at which the noise of bright field vanishes, relative to the vacuum: a dark level, less what read noise hides.

    The noise is what no slope explains of 2 x 2 pixels of the images themselves, because a fit follows noise where there is
    matter. The neighbouring tilts, whose noise is their own, give the signal and show where fine detail would add to the noise.
    Every tilt may have a gain of its own. If noise in proportion to the signal explains it significantly better, the level is 0.
    """
    if mode == "linear":
        raise NotTested("the images are not bright field")
    vacuum = float(np.quantile(residuals.projections[residuals.used], 0.99))
    used, images, expected = (_squares(each) for each in (residuals.used, residuals.images, residuals.projections))
    noise, detail = (np.abs(each[0] - each[1] - each[2] + each[3]) / (2 * vacuum) for each in (images, expected))
    if not noise.size:
        raise NotTested("needs two rows")
    # of the tilts before and after: noise that a fit has followed in part would look like more noise at more signal
    signal, detail = (np.pad(each, ((1, 1), (0, 0), (0, 0)), "reflect") for each in (expected.mean(0) / vacuum, detail))
    signal = np.maximum((signal[:-2] + signal[2:]) / 2, LEAST_SHARE, dtype=np.float64)
    known = used.all(0) & (np.maximum(detail[:-2], detail[2:]) < _DETAIL * robust_deviation(noise, 0.0))
    known &= known.sum((1, 2), keepdims=True) > AROUND
    if not noise[known].any():
        raise NotTested("no smooth part of the images shows their noise")
    # beams differ between tilts, and a fit that is too smooth has less contrast than the images
    seen, told = ((each * known).sum((1, 2), keepdims=True) for each in (images.mean(0) / vacuum, signal))
    signal *= np.where(known.any((1, 2), keepdims=True), seen / np.maximum(told, 1e-30), 1)
    line = weighted_line(signal[known], images.mean(0)[known] / vacuum, 1 / signal[known] ** 2)
    signal = np.maximum(line.intercept + line.slope * signal, LEAST_SHARE)
    most = SIGNIFICANT * robust_deviation((noise / np.sqrt(signal))[known], 0.0) or np.inf
    noise = np.minimum(noise, most * np.sqrt(signal)) ** 2  # without spikes
    weight = known / signal**2 / np.maximum((known / signal**2).sum((1, 2), keepdims=True), 1e-30)
    power, usual, square = ((each * weight).sum((1, 2), keepdims=True) for each in (noise, signal, signal**2))
    known &= power > 0
    gain = usual / np.where(power > 0, power, np.inf)
    # counts have none left; a level adds the first column, and noise in proportion to the signal a part of the second
    columns = (
        gain * noise - signal,
        signal / np.maximum(usual, 1e-30) - 1,
        signal**2 * usual / np.maximum(square, 1e-30) - signal,
    )
    left, level, steep = ((each / signal)[known] for each in columns)
    tilt = np.broadcast_to(np.arange(len(signal))[:, None, None], known.shape)[known]
    (slope,), (error,) = white_regression(level[:, None], left, clusters=tilt)
    share = np.clip(steep @ left / (steep @ steep), 0, 1)
    worse = np.sum((left - slope * level) ** 2) - np.sum((left - share * steep) ** 2)
    slope = max(float(slope), 0.0) if worse < LIKELY**2 * left.var() else 0.0
    lower = 1 + slope / float(usual[power > 0].mean())
    return Effect(slope / lower, float(error) / lower**2, f"{slope / lower * vacuum:.3g}")


def _squares(images: Array) -> Array:
    """(4, tilt, y − 1, u − 1) the pixels of all squares of 2 x 2."""
    return np.stack([images[:, y : y - 1 or None, u : u - 1 or None] for y in (0, 1) for u in (0, 1)])


def _span(images: Array) -> float:
    return float(np.quantile(images, 0.99) - np.quantile(images, 0.01))
