"""The transform between two frames: guesses from matched features or from cross-correlation, their refinement, and its error."""

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
Motion = Literal["translation", "euclidean", "affine"]

MOTIONS: dict[Motion, int] = {"translation": 2, "euclidean": 3, "affine": 6}
"""Motion models and their numbers of parameters."""

LARGE = 512
"""Side to which larger frames are binned for their correlation and for their first registration, pixels. It has tens of thousands
of independent details; the registration is refined at full size."""

BANDS = 1.5, 4.0
"""Blur of the fine and of the coarse band in which frames are compared, pixels."""

MINIMUM_OVERLAP = 0.25
"""Smallest fraction of the short frame that the long one must cover."""

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
    for blur in BANDS:
        factor = max(1, int(blur / BANDS[0]), max(short.shape) // LARGE)
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
    the equal peaks of a crystal lattice. Shifts with an overlap below `MINIMUM_OVERLAP` are set to 0.

    Args:
        first, second: (y, x) of mean 0 and standard deviation 1.

    Returns:
        (2y, 2x) or somewhat larger: the value at shift d is that of first(p)·second(p + d), with d = 0 at [0, 0].
    """
    products = np.fft.irfft2(*cross_spectrum(first, second))
    steps = (np.minimum(place := np.arange(size), size - place) for size in products.shape)
    overlap = np.multiply.outer(*(np.maximum(side - step, 0) for side, step in zip(first.shape, steps, strict=True)))
    return np.asarray(np.where(overlap > MINIMUM_OVERLAP * first.size, products / np.sqrt(overlap.clip(1)), 0.0))


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


def covered(matrix: Image, shape: tuple[int, ...], *, border: float = 2.0) -> NDArray[np.bool_]:
    """Return the (y, x) mask of the short frame's pixels that lie inside the long one, at least `border` pixels from its edge."""
    row, column = np.arange(shape[0])[:, None], np.arange(shape[1])
    x, y = (line[0] * column + line[1] * row + line[2] for line in matrix)
    inside: NDArray[np.bool_] = (
        (x >= border) & (x <= shape[1] - 1 - border) & (y >= border) & (y <= shape[0] - 1 - border)
    )
    return inside


def interpolated(long: Image, matrix: Image) -> Image:
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(long, matrix, long.shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT))


def correlation_at(short: Image, long: Image, matrix: Image, *, blur: float) -> tuple[float, float]:
    """Correlation of two frames under a transform, band-passed at `blur` pixels, and its standard deviation for unrelated frames.

    The standard deviation follows Bartlett's formula: the square root of the product of the autocorrelations summed over all
    shifts, divided by the number of pixels. By Parseval's theorem this sum equals that of the squared cross-spectrum.
    """
    factor = max(1, min(short.shape) // LARGE)
    mask = block_means(covered(matrix, short.shape).astype(float), factor, factor) == 1
    bands = (
        band_pass(block_means(image, factor, factor), blur / factor) for image in (short, interpolated(long, matrix))
    )
    first, second = (np.where(mask, band - band[mask].mean(), 0.0) for band in bands)
    energy = max(float(np.linalg.norm(first) * np.linalg.norm(second)), np.finfo(float).tiny)
    spectrum, (height, width) = cross_spectrum(first, second)
    squares = np.sum(spectrum.real**2 + spectrum.imag**2, axis=0)
    total = 2 * squares.sum() - squares[0] - squares[-1] * (width % 2 == 0)
    return float(np.vdot(first, second)) / energy, float(np.sqrt(total / (height * width * mask.sum()))) / energy


def restricted(matrix: Image, motion: Motion, shape: tuple[int, ...]) -> Image:
    """Return the transform of this motion that displaces the frame's centre as `matrix` does."""
    centre = (np.array(shape[::-1]) - 1) / 2
    target = matrix[:, :2] @ centre + matrix[:, 2]
    left, _, right = np.linalg.svd(matrix[:, :2])
    linear = {"translation": np.eye(2), "euclidean": left @ right, "affine": matrix[:, :2]}[motion]
    return np.column_stack([linear, target - linear @ centre])


def maximise_correlation(
    short: Image, long: Image, start: Image, motion: Motion, *, fine: bool = False
) -> Image | None:
    """Refine a transform by the enhanced correlation coefficient, coarse unless it is fine, then fine; None if it diverges."""
    kind = getattr(cv2, f"MOTION_{motion.upper()}")
    first, second = (((image - image.mean()) / image.std()).astype(np.float32) for image in (short, long))
    centre = np.append((np.array(short.shape[::-1]) - 1) / 2, 1)
    matrix, reach = start, INLIER_DISTANCE * max(1, max(short.shape) / LARGE)  # largest error of a guess, pixels
    for blur, steps, tolerance in ((15, 30, 1e-5), (5, 60, 1e-8))[fine:]:
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, steps, tolerance)
        try:
            _, moved = cv2.findTransformECC(first, second, matrix.astype(np.float32), kind, criteria, None, blur)  # type: ignore[call-overload]
        except cv2.error:  # raised if the iteration does not converge
            moved = np.full_like(matrix, np.inf)
        if np.linalg.norm((moved - start) @ centre) <= reach:
            matrix = np.asarray(moved, float)
        elif blur == 5:  # the coarse step may fail, because it blurs a fine crystal lattice away
            return None
    return matrix


def information(short: Image, long: Image, matrix: Image, mask: NDArray[np.bool_]) -> float:
    """Twice the Gaussian log-likelihood of the short frame given the best linear function of the warped long one, nats."""
    coefficient = np.corrcoef(short[mask], interpolated(long, matrix)[mask])[0, 1]
    return float(-mask.sum() * np.log1p(-(coefficient**2)))


def standard_error(short: Image, long: Image, matrix: Image, motion: Motion) -> float:
    """Rms displacement error over the frame, pixels, from the Cramér–Rao bound at the observed residual variance."""
    mask = covered(matrix, short.shape)
    smooth = smoothed(interpolated(long, matrix), 1.0)
    slope, offset = np.polyfit(smooth[mask], short[mask], 1)
    variance = float(np.var((short - slope * smooth - offset)[mask]))
    row, column = np.indices(short.shape)
    x, y = ((index - (size - 1) / 2)[mask] for index, size in zip((column, row), short.shape[::-1], strict=True))
    one, none = np.ones_like(x), np.zeros_like(x)
    along_x, along_y = {
        "translation": ([one, none], [none, one]),
        "euclidean": ([one, none, -y], [none, one, x]),
        "affine": ([one, none, x, y, none, none], [none, one, none, none, x, y]),
    }[motion]
    gradient_y, gradient_x = (slope * np.asarray(part)[mask] for part in np.gradient(smooth))
    jacobian = np.stack(along_x) * gradient_x + np.stack(along_y) * gradient_y
    information = jacobian @ jacobian.T
    if np.linalg.cond(information) > 1e14:
        return float("inf")
    spread = (np.stack(along_x) @ np.stack(along_x).T + np.stack(along_y) @ np.stack(along_y).T) / mask.sum()
    return float(np.sqrt(variance * np.trace(np.linalg.solve(information, spread))))
