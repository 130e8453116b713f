"""Initial guesses of the transform between two frames, from matched features or from cross-correlation."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from calibration.exposures.scaling import smoothed
from noiseflow.statistics import block_means

Method = Literal["sift", "phase correlation", "unshifted"]

INLIER_DISTANCE = 2.0
"""Largest distance between a match and the transform it agrees with, pixels."""


@dataclass(frozen=True)
class Guess:
    """An initial transform: (x, y) in the short frame -> (x, y) in the long one.

    Attributes:
        matrix: (2, 3) matrix, pixels.
        method: method that produced it.
        points: (inlier, 2, 2) matched points (x, y): [:, 0] in the short, [:, 1] in the long frame; empty without features.
        matches: number of matches before RANSAC.
    """

    matrix: Image
    method: Method
    points: Image
    matches: int


def feature_guesses(short: Image, long: Image) -> Iterator[Guess]:
    """Yield guesses from SIFT and RANSAC at increasing smoothing.

    The smoothed 8-bit copies of the frames are used only for matching.
    """
    for blur in (1.0, 2.0, 4.0):
        yield from _guesses_at(short, long, blur)


def correlation_guesses(short: Image, long: Image, *, largest_angle: float = 4.0) -> Iterator[Guess]:
    """Yield guesses from the peak of the band-passed cross-correlation over a range of rotations, for scenes without features.

    Args:
        short, long: (y, x).
        largest_angle: search range ± degrees, in steps that move the frame's edge by about 1.5 pixels.

    Yields:
        The best guess for the finest and for a coarser band.
    """
    for blur in (1.5, 4.0):
        factor = max(1, int(blur / 1.5), max(short.shape) // 512)
        first, second = (block_means(band_pass(image, blur), factor, factor) for image in (short, long))
        step = np.degrees(3.0 / max(first.shape))
        angles = np.arange(-np.ceil(largest_angle / step), np.ceil(largest_angle / step) + 1) * step
        _, matrix = max((_best_shift(first, second, angle) for angle in angles), key=lambda item: item[0])
        yield Guess(scaled(matrix, factor), "phase correlation", np.empty((0, 2, 2)), 0)


def band_pass(image: Image, blur: float) -> Image:
    """Band-pass an image and standardise it to mean 0 and standard deviation 1.

    The filter removes noise finer than `blur` pixels, and shading coarser than eight times `blur` or `blur` plus a tenth of the
    frame, whichever is smaller.
    """
    shading = min(8 * blur, blur + 0.1 * min(image.shape))
    band = smoothed(image, blur) - smoothed(image, shading)
    band = np.clip(band, *np.percentile(band, (0.05, 99.95)))
    return np.asarray((band - band.mean()) / max(band.std(), np.finfo(float).tiny))


def correlation_surface(first: Image, second: Image) -> Image:
    """Correlation of two frames at every shift, times the square root of their overlap.

    With this factor the values of unrelated frames have equal variance at all shifts, and the smallest shift is favoured among
    the equal peaks of a crystal lattice. Shifts with an overlap of less than a quarter of the frame are set to 0.

    Args:
        first, second: (y, x) of mean 0 and standard deviation 1.

    Returns:
        (2y, 2x) or somewhat larger: the value at shift d is that of first(p)·second(p + d), with d = 0 at [0, 0].
    """
    products = np.fft.irfft2(*cross_spectrum(first, second))
    steps = (np.minimum(place := np.arange(size), size - place) for size in products.shape)
    overlap = np.multiply.outer(*(np.maximum(side - step, 0) for side, step in zip(first.shape, steps, strict=True)))
    return np.asarray(np.where(overlap > 0.25 * first.size, products / np.sqrt(overlap.clip(1)), 0.0))


def cross_spectrum(first: Image, second: Image) -> tuple[NDArray[np.complex128], list[int]]:
    """Half of the Fourier transform of the linear (not circular) cross-correlation, and the shape of the whole."""
    shape = [cv2.getOptimalDFTSize(2 * n) for n in first.shape]
    return np.conj(np.fft.rfft2(first, shape)) * np.fft.rfft2(second, shape), shape


def _guesses_at(short: Image, long: Image, blur: float, *, ratio: float = 0.8) -> Iterator[Guess]:
    """Yield guesses from matches whose distance is at most `ratio` of the second-best one's (Lowe,
    doi:10.1023/B:VISI.0000029664.99615.94)."""
    sift = cv2.SIFT_create(nfeatures=2000, contrastThreshold=0.02)  # type: ignore[attr-defined]
    keys, descriptors = sift.detectAndCompute(_eight_bits(short, blur), None)
    for sign in (1.0, -1.0):  # -1: the contrast of one frame is inverted
        other_keys, other = sift.detectAndCompute(_eight_bits(sign * long, blur / 2), None)
        if descriptors is None or other is None or len(keys) < 2 or len(other_keys) < 2:
            continue
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, other, k=2)
        kept = [p[0] for p in pairs if len(p) == 2 and p[0].distance < ratio * p[1].distance]
        points = np.array([[keys[m.queryIdx].pt, other_keys[m.trainIdx].pt] for m in kept]).reshape(-1, 2, 2)
        guess = _consensus(points)
        if guess is not None:
            yield guess


def _consensus(points: Image) -> Guess | None:
    """Fit a similarity transform to the matches by RANSAC; None if too few agree."""
    if len(points) < 4:
        return None
    cv2.setRNGSeed(0)
    options: dict[str, Any] = {"ransacReprojThreshold": INLIER_DISTANCE, "maxIters": 5000, "confidence": 0.9999}
    first, second = (np.ascontiguousarray(points[:, i]) for i in (0, 1))
    matrix, inlier = cv2.estimateAffinePartial2D(first, second, method=cv2.RANSAC, **options)
    if matrix is None or inlier.sum() < max(4, 0.05 * len(points)):
        return None
    return Guess(np.asarray(matrix, float), "sift", points[inlier[:, 0] > 0], len(points))


def _eight_bits(image: Image, blur: float) -> NDArray[np.uint8]:
    smooth = smoothed(image, blur)
    low, high = np.percentile(smooth, (0.5, 99.8))
    stretched = np.clip((smooth - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    return np.asarray(np.round(255 * stretched), dtype=np.uint8)


def _best_shift(first: Image, second: Image, angle: float, *, inverted: float = 0.8) -> tuple[float, Image]:
    """Height of the highest correlation peak after rotating `second` back by `angle` degrees, and its (2, 3) matrix.

    A negative correlation has a lower weight: a crystal lattice shifted by half a period resembles its negative.
    """
    rows, columns = first.shape
    turn = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), -angle, 1.0)
    turned = cv2.warpAffine(second, turn, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    surface = correlation_surface(first, np.asarray(turned, float))
    surface = np.maximum(surface, -inverted * surface)
    peak = np.array(np.unravel_index(np.argmax(surface), surface.shape))
    shift = np.where(peak < np.array(surface.shape) / 2, peak, peak - surface.shape)[::-1]
    return float(surface.max()), np.column_stack([turn[:, :2], turn[:, 2] + turn[:, :2] @ shift])


def scaled(matrix: Image, factor: float) -> Image:
    """Convert a transform to pixels `factor` times smaller (pixel centres at integers in both)."""
    middle = (factor - 1) / 2
    linear = matrix[:, :2]
    return np.column_stack([linear, factor * matrix[:, 2] + middle - linear @ np.array([middle, middle])])
