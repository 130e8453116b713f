"""Motions of a frame: where one frame shows what another shows, how alike the two are there, and refinement."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from calibration.exposures.scaling import smoothed
from calibration.registration.matching import INLIER_DISTANCE, band_pass, cross_spectrum
from noiseflow.statistics import block_means

Motion = Literal["translation", "euclidean", "affine"]

MOTIONS: dict[Motion, int] = {"translation": 2, "euclidean": 3, "affine": 6}
"""Motion models and their numbers of parameters."""

LARGE = 512
"""Side to which larger frames are binned for their correlation and for their first registration, pixels. It has tens of thousands
of independent details; the registration is refined at full size."""


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
    matrix, reach = start, INLIER_DISTANCE * max(1, max(short.shape) / 512)  # largest error of a guess, pixels
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
