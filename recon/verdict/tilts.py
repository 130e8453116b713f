"""Statistics of the tilts: range, gaps, duplicate images, and images that do not match their neighbours or their angle."""

import hashlib

import numpy as np
from scipy import linalg, ndimage

from noiseflow.checks import Effect, NotTested
from noiseflow.statistics import STANDARD_ERRORS, Array, neighbour_products, robust_deviation
from recon.projection.classical import directions
from recon.series.tilt_series import TiltSeries
from recon.series.views import AROUND, HARMLESS
from recon.verdict.compared import Coarse, neighbours

_FOREIGN = 0.3  # share of the structure below which errors are harmless


def gaps_between(angles: Array) -> Array:
    """(direction,) the ranges of directions without tilts, degrees, widest first."""
    return np.sort(directions(angles)[2])[::-1]


def repeated(tilt_series: TiltSeries) -> Effect:
    """Share of images that are exactly equal to another, which noise excludes for separate exposures."""
    different = {hashlib.sha256(image.tobytes()).digest() for image in tilt_series.images}
    return Effect(1 - len(different) / tilt_series.num_tilts)


def normalised(tilt_series: TiltSeries) -> Effect:
    """1 if every image has the same mean and deviation, the same quantiles, or the same range, whose upper end is a single pixel
    and no limit of the detector: each was scaled by itself. Images of a round object differ by more than rounding."""
    moments, quantiles, ranges, counts = list[Array](), list[Array](), list[Array](), True
    for part in tilt_series.values():  # one at a time: images may be on the disk
        values = np.sort(part.astype(np.float64))
        counts &= np.array_equal(values, np.round(values))
        moments.append(np.array([values.mean(), values.std()]))
        quantiles.append(np.quantile(values, (0.01, 0.99)))
        ranges += [values[[0, -1]]] if values[-2] < values[-1] else []
    size = float(np.mean(moments, axis=0)[1])
    if counts:  # whose quantiles are equal without scaling
        alike = len(ranges) > tilt_series.num_tilts / 2 and not np.ptp(ranges, axis=0).any()
        return Effect(float(alike or np.ptp(moments, axis=0).max() < 1e-3 * size))
    return Effect(float(min(np.ptp(each, axis=0).max() for each in (moments, quantiles)) < 1e-5 * size))


def twins(coarse: Coarse) -> Effect:
    """Share of the structure by which images of one direction differ, beside their shifts across the axis, which other checks
    measure; noise is independent between neighbouring rows."""
    close = np.diff(np.sort(coarse.directions.angles)) < HARMLESS["direction"]
    if not close.any() or coarse.images.shape[1] < 2:
        return Effect(0.0)
    images = coarse.arranged()
    one, other, width = np.fft.rfft(images[:-1][close]), images[1:][close], images.shape[2]
    most, wave = HARMLESS["shift"] * width, -2j * np.pi * np.fft.rfftfreq(width)
    moved = (np.fft.irfft(one * np.exp(wave * shift), width) - other for shift in np.arange(-most, most + 0.5, 0.5))
    shared = np.min([[neighbours(each[None], 1) for each in pairs] for pairs in moved], axis=0)
    return Effect(max(0.0, float(shared.mean())) / 2 / max(neighbours(coarse.centred_on_all, 1), 1e-30))


def jumps(coarse: Coarse, *, large: float = 0.1) -> Effect:
    """Largest difference of neighbouring tilts relative to those around, although a rotating object changes smoothly.

    The structure common to neighbouring rows of the difference is free of noise; it grows with the square of the step. A share
    below a `large` one is harmless; misalignment of a low-noise needle gives 0.001.
    """
    images, angles = coarse.arranged(), np.sort(coarse.directions.angles)
    apart = np.diff(angles) > HARMLESS["direction"]
    if apart.sum() < AROUND or images.shape[1] < 2:
        raise NotTested(f"needs two rows and {AROUND + 1} directions")
    differences, steps = np.diff(images, axis=0)[apart], np.diff(angles)[apart]
    shared = neighbour_products(differences, axis=1).mean((1, 2)) / steps**2
    chance = (differences**2).mean((1, 2)) / np.sqrt(images[0].size) / steps**2
    usual = np.maximum(ndimage.median_filter(shared, AROUND, mode="nearest"), chance)
    seen = shared * steps**2 > large * max(neighbours(coarse.centred_on_all, 1), 1e-30)
    ratios = np.divide(shared - 3 * chance, usual, out=np.zeros_like(usual), where=seen)  # exact copies give usual = 0
    largest = int(np.argmax(ratios))
    first, second = np.flatnonzero(apart)[largest] + (0, 1)
    return Effect(float(ratios[largest]), what=f"{angles[first]:g}° and {angles[second]:g}°")


def smoothest_order(images: Array) -> Array:
    """(tilt,) the order of images (tilt, y, u) in which neighbours are alike, forwards or backwards.

    Their Laplacian has it in its second eigenvector (spectral seriation, doi:10.1137/S0097539795285771). Products of
    neighbouring rows leave out the noise.
    """
    if images.shape[1] < 2:
        raise NotTested("needs two rows")
    upper, lower = (rows.reshape(len(images), -1) for rows in (images[:, 1:], images[:, :-1]))
    common = upper @ lower.T
    power = np.diag(common)
    distance = np.maximum(power[:, None] + power - common - common.T, 0)
    nearest = np.sort(distance, axis=1)[:, 1:3]  # of two neighbours
    alike = np.exp(-distance / max(float(np.median(nearest)), 1e-30))
    degree = np.sqrt(alike.sum(1))
    return np.argsort(linalg.eigh(alike / np.outer(degree, degree))[1][:, -2] / degree)


def foreign(coarse: Coarse, errors: Array) -> Effect:
    """Share of tilts that are blank or that the others hardly predict, by the structure of neighbouring rows beyond noise."""
    if coarse.images.shape[1] < 2:
        raise NotTested("needs two rows")
    measured, predicted = coarse.centred(coarse.images), coarse.centred(coarse.images - errors)
    agreement = (predicted[:, 1:] * measured[:, :-1]).mean((1, 2))
    chance = STANDARD_ERRORS * np.sqrt((predicted**2).mean((1, 2)) * (measured**2).mean((1, 2)) / measured[0].size)
    own = (measured[:, 1:] * measured[:, :-1]).mean((1, 2))
    order = coarse.directions.order
    beside = ndimage.maximum_filter1d(own[order], 3, mode="nearest")[np.argsort(order)]
    noise = STANDARD_ERRORS * (measured**2).mean((1, 2)) / np.sqrt(measured[0].size)
    found = (agreement + chance < _FOREIGN * own) | (own + noise < _FOREIGN * beside)
    return Effect(float(found.mean()), what=_named(coarse.tilt_angles[found]))


def single(coarse: Coarse, errors: Array) -> Effect:
    """Largest deviation of a tilt's prediction error from those of its neighbours, in typical deviations."""
    images, left = coarse.directions.arranged(coarse.centred(coarse.images)), coarse.arranged(errors)
    own, shared = (neighbour_products(each, axis=1).mean((1, 2)) for each in (images, left))
    beyond = shared - ndimage.median_filter(shared, AROUND + 2, mode="nearest")
    beyond[:2] = beyond[-2:] = 0  # tilts at the ends have few neighbours
    beyond[beyond < _FOREIGN * float(np.median(own))] = 0
    worst = int(np.argmax(beyond))
    named = _named(coarse.tilt_angles[coarse.directions.order][[worst]])
    return Effect(float(beyond[worst] / max(robust_deviation(shared - np.median(shared)), 1e-30)), what=named)


def broken(coarse: Coarse) -> Effect:
    """Lost share of the structure common to neighbouring images at the only break of the series."""
    flat, angles = coarse.directions.arranged(coarse.centred(coarse.images)), np.sort(coarse.directions.angles)
    steps = np.diff(angles)
    if len(flat) < 2 * AROUND:
        raise NotTested(f"needs {2 * AROUND} tilts")
    power = (flat**2).mean((1, 2))
    shared = (flat[1:] * flat[:-1]).mean((1, 2))
    chance = np.sqrt(power[1:] * power[:-1] / flat[0].size)
    usual = ndimage.median_filter(shared, AROUND, mode="nearest")
    lost = np.where(steps < 1.5 * np.median(steps), 1 - shared / np.maximum(usual, 1e-30), 0.0)
    apart = (lost > 0.5) & (usual - shared > 4 * chance)
    if apart.sum() != 1:  # several breaks mean wrong angles, which other checks detect
        return Effect(0.0)
    where = int(np.argmax(apart))
    return Effect(float(lost[where]), what=f"up to {angles[where]:g}° and from {angles[where + 1]:g}° on")


def _named(angles: Array) -> str:
    return ", ".join(f"{angle:g}°" for angle in angles[:5])
