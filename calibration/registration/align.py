"""Registration of a long exposure to a short one, and warping of the long exposure.

Only the long exposure is interpolated. Interpolating the short one would correlate and reduce the noise to be measured.
"""

import functools
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from calibration.exposures.scaling import alike_apart, smoothed
from calibration.registration.matching import (
    BANDS,
    INLIER_DISTANCE,
    LARGE,
    MINIMUM_OVERLAP,
    MOTIONS,
    Guess,
    Method,
    Motion,
    band_pass,
    correlation_at,
    correlation_guesses,
    correlation_surface,
    covered,
    feature_guesses,
    information,
    interpolated,
    maximise_correlation,
    restricted,
    scaled,
    standard_error,
)
from calibration.tolerances import CERTAIN
from noiseflow.described import described
from noiseflow.io import as_array
from noiseflow.statistics import block_means

SAME_SCENE = 0.9
"""Correlation above which small frames and crystal lattices, which have too few independent details for `CERTAIN`, show one
scene. Unrelated frames that overlap by half, without rotation or magnification, reach 0.75."""

LARGEST_TURN = 0.05
"""Largest rotation or magnification (3° or 5 %) of a registration that rests on correlation alone, and largest change of a guess
by its refinement. At larger values a crystal lattice may fit another one."""


@described(rms_px="px", error_px="px")
@dataclass(frozen=True)
class Registration:
    """Transform from the pixels of the short frame to those of the long one.

    Attributes:
        matrix: (2, 3) matrix: (x, y, 1) in the short frame -> (x, y) in the long one, pixels.
        motion: the simplest motion model that the data support.
        method: source of the initial guess, which is refined by maximising the enhanced correlation coefficient.
        inliers, matches: numbers of matches that agree with the transform (0 for phase correlation), and before RANSAC.
        rms_px: root mean square distance of the inlier matches from the transform, pixels; for phase correlation `error_px`.
        error_px: standard error of the transform due to the noise of the short exposure, rms over the frame, pixels.
        peak: correlation, in standard deviations of the correlation of unrelated frames with the same spectra.
        inverted: whether the frames have opposite contrast.
        mosaic: whether the frames are mosaics of colour filters, whose colours `warp` interpolates each alone.
    """

    matrix: Image
    motion: Motion
    method: Method
    inliers: int
    matches: int
    rms_px: float
    error_px: float
    peak: float
    inverted: bool
    mosaic: bool = False

    @property
    def rotation(self) -> float:
        """Degrees, positive from x towards y."""
        return float(
            np.degrees(np.arctan2(self.matrix[1, 0] - self.matrix[0, 1], self.matrix[0, 0] + self.matrix[1, 1]))
        )

    @property
    def scale(self) -> float:
        """Linear magnification (square root of the magnification of areas)."""
        return float(np.sqrt(np.linalg.det(self.matrix[:, :2])))

    def shift(self, shape: tuple[int, ...]) -> tuple[float, float]:
        """Displacement (x, y) of the centre of a frame with `shape` (y, x), pixels."""
        centre = (np.array(shape[::-1]) - 1) / 2
        x, y = self.matrix[:, :2] @ centre + self.matrix[:, 2] - centre
        return float(x), float(y)

    def interpolates(self, shape: tuple[int, ...], least: float = 0.01) -> bool:
        """Whether `warp` interpolates frames of `shape`, which moves a corner by at `least` so many pixels."""
        size = shape[::-1]
        corners = np.array([[0, 0, 1], [size[0], 0, 1], [0, size[1], 1], [*size, 1]], float)
        return bool(np.abs(corners @ self.matrix.T - corners[:, :2]).max() >= least)

    def warp(self, long: Image) -> tuple[Image, NDArray[np.bool_]]:
        """Warp the long frame onto the pixels of the short one.

        A shift below 0.01 pixels is ignored, because interpolation would only smooth the frame.

        Returns:
            (y, x) warped frame, and (y, x) mask of the pixels that it covers.
        """
        if not self.interpolates(long.shape):
            return long, np.ones(long.shape, bool)
        flags, warped, apart = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP, np.empty(long.shape), 1 + self.mosaic
        moved = functools.partial(cv2.warpAffine, flags=flags, borderMode=cv2.BORDER_REFLECT)
        for y, x in np.ndindex(apart, apart):
            colour, shift = long[y::apart, x::apart].copy(), (self.matrix @ (x, y, 1) - (x, y)) / apart
            warped[y::apart, x::apart] = moved(colour, np.column_stack([self.matrix[:, :2], shift]), colour.shape[::-1])
        return warped, covered(self.matrix, long.shape, border=2.0 * apart)

    def noise(self, shape: tuple[int, ...]) -> tuple[Image, Image]:
        """Return white noise of unit variance, and the same warped as a long frame; it shows what interpolation keeps."""
        return _noise(self.matrix.tobytes(), shape, self.mosaic)


@functools.lru_cache(maxsize=2)  # several measurements of one pair ask for it
def _noise(matrix: bytes, shape: tuple[int, ...], mosaic: bool) -> tuple[Image, Image]:
    transform = Registration(np.frombuffer(matrix).reshape(2, 3), "affine", "sift", 0, 0, 0.0, 0.0, 0.0, False, mosaic)
    return (white := np.random.default_rng(0).standard_normal(shape)), transform.warp(white)[0]


def register(
    short: Image,
    long: Image,
    *,
    names: tuple[str, str] = ("the short", "the long exposure"),
    near: Registration | None = None,
    still: bool = False,
) -> Registration:
    """Find the transform from the short frame to the long one.

    The initial guess comes from SIFT matches, Lowe's ratio test and RANSAC, or from the peak of the cross-correlation if the
    scene has too few features. Maximising the enhanced correlation coefficient (doi:10.1109/TPAMI.2008.113) refines it to
    sub-pixel accuracy as translation, Euclidean or affine motion; the Bayesian information criterion selects the motion.

    A registration is accepted in three cases: the frames correlate more than unrelated frames do (`CERTAIN`); they correlate
    almost perfectly without notable rotation (`SAME_SCENE`, for small frames and crystal lattices); or at least 30 matches, and
    the majority of all, agree with it. Unless the matches are conclusive, the guess from the cross-correlation is refined too,
    and the more likely registration is returned. A crystal lattice fits itself at many shifts; the most likely one is returned,
    which is the smallest for a perfect crystal lattice, whose residuals are equal at all of them.

    Args:
        short: (y, x) detector units.
        long: (y, x) of the same size, any linear scale.
        names: names of the two frames in messages.
        near: registration of a neighbouring frame, which is refined first, and is enough if it is accepted.
        still: whether the frames may be taken as they lie if nothing else is accepted: those of a smooth scene correlate at four
            pixels only, where a search would find high correlations by chance.

    Raises:
        ValueError: no transform aligns the frames, or they overlap by less than `MINIMUM_OVERLAP`.

    Example:
        >>> import calibration, numpy as np
        >>> from scipy.ndimage import gaussian_filter
        >>> scene = gaussian_filter(np.random.default_rng(0).random((128, 128)), 2) * 1000
        >>> found = calibration.register(scene, np.roll(scene, (3, 5), axis=(0, 1)))
        >>> found.matrix[:, 2].round().tolist()  # (x, y), pixels
        [5.0, 3.0]
    """
    short, long = (np.asarray(as_array(frame), dtype=np.float64) for frame in (short, long))
    if alike_apart(long) > 1:  # the scene moves, and the filters do not: means of four pixels hold all colours
        grey = [block_means(one, 2, 2) for one in (short, long)]
        half = near and replace(near, matrix=scaled(near.matrix, 0.5))
        one = register(*grey, names=names, near=half, still=still)
        matrix, errors = scaled(one.matrix, 2), {name: 2 * getattr(one, name) for name in ("rms_px", "error_px")}
        refined = maximise_correlation(short, (-1 if one.inverted else 1) * long, matrix, one.motion, fine=True)
        return replace(one, matrix=matrix if refined is None else refined, mosaic=True, **errors)
    tried, factor = {"overlap": 1.0, "matches": 0.0}, min(short.shape) // LARGE
    if factor > 1:
        coarse, other = (block_means(frame, factor, factor) for frame in (short, long))
        for one in itertools.islice(_standing(coarse, other, feature_guesses(coarse, other), tried), 1):
            if _beyond_doubt(one):
                matrix = scaled(one.matrix, factor)
                refined = maximise_correlation(short, long, matrix, one.motion, fine=True)
                errors = {name: factor * getattr(one, name) for name in ("rms_px", "error_px")}
                return replace(one, matrix=matrix if refined is None else refined, **errors)
    first = [] if near is None else [Guess(near.matrix, near.method, np.empty((0, 2, 2)), 0)]
    guesses = itertools.chain(first, feature_guesses(short, long))
    found = list(itertools.islice(_standing(short, long, guesses, tried), 1))
    if any(_beyond_doubt(one) or (first and not one.matches and not one.inverted) for one in found):
        return found[0]
    found += _standing(short, long, correlation_guesses(short, long), tried)
    if still and not found:
        found += _standing(short, long, [Guess(np.eye(2, 3), "unshifted", np.empty((0, 2, 2)), 0)], tried)
    if found:
        best = functools.reduce(lambda *two: _better(short, long, *two), found)
        others = _standing(short, long, _equal_peaks(short, long, best.matrix), tried)
        return functools.reduce(lambda *two: _better(short, long, *two), others, best)
    reason = f"SIFT found {tried['matches']:.0f} consistent matches and their correlation has no clear peak"
    reason = f"they overlap by only {tried['overlap']:.0%}" if tried["overlap"] < MINIMUM_OVERLAP else reason
    raise ValueError(
        f"{names[0]} and {names[1]} cannot be registered: {reason}; check that both show the same field of view "
        "at the same magnification, or use a longer short exposure; frames of uniform light belong to --flat"
    )


def _standing(short: Image, long: Image, guesses: Iterable[Guess], tried: dict[str, float]) -> Iterator[Registration]:
    """Yield the refined registrations of the guesses that are accepted; `tried` keeps the last overlap and the most matches."""
    for guess in guesses:
        tried["matches"] = max(tried["matches"], len(guess.points))
        if not _plausible(guess.matrix):
            continue
        tried["overlap"] = float(covered(guess.matrix, short.shape).mean())
        if tried["overlap"] >= MINIMUM_OVERLAP and (found := _refined(short, long, guess)) is not None:
            yield found


def _beyond_doubt(found: Registration) -> bool:
    """Whether the matches are conclusive, without a rotation or inversion under which a crystal lattice fits itself."""
    return _conclusive(found.inliers, found.matches) and not found.inverted and _turn(found.matrix) <= LARGEST_TURN


def _equal_peaks(short: Image, long: Image, matrix: Image, *, height: float = 0.7) -> list[Guess]:
    """Shift the transform to the other correlation peaks of a crystal lattice: the eight with the smallest displacement of the
    frame's centre; none for other scenes, whose other peaks are lower than `height` times the one at the registered position.

    The integer shift next to the maximum of a period of 5 pixels has 0.8.
    """
    correlation, _ = correlation_at(short, long, matrix, blur=BANDS[0])
    if abs(correlation) < SAME_SCENE:
        return []
    first, second = (band_pass(image, BANDS[0]) for image in (short, interpolated(long, matrix)))
    surface = correlation_surface(first, np.sign(correlation) * second)
    tops = surface == cv2.dilate(np.pad(surface, 1, mode="wrap"), np.ones((3,) * 2, np.uint8))[1:-1, 1:-1]
    peaks = np.argwhere(tops & (surface > height * surface[0, 0]))
    shifts = np.where(peaks < np.array(surface.shape) / 2, peaks, peaks - surface.shape)[:, ::-1]
    centre = (np.array(short.shape[::-1]) - 1) / 2
    linear, offset = matrix[:, :2], matrix[:, 2]
    moved = [offset + linear @ shift for shift in shifts[np.abs(shifts).max(axis=1) > 1]]
    least = sorted(moved, key=lambda one: float(np.linalg.norm(linear @ centre + one - centre)))[:8]
    return [Guess(np.column_stack([linear, one]), "phase correlation", np.empty((0, 2, 2)), 0) for one in least]


def _better(short: Image, long: Image, first: Registration, second: Registration) -> Registration:
    """Select one of two registrations.

    If only one preserves the contrast, it is selected: shifted by half a period, a crystal lattice may equal its negative.
    Otherwise the one with the higher likelihood on the common area is selected; within the statistical error of the likelihood,
    the one that covers more.
    """
    if first.inverted != second.inverted:
        return second if first.inverted else first
    masks = [covered(one.matrix, short.shape) for one in (first, second)]
    both = masks[0] & masks[1]
    if not both.any():
        return max(first, second, key=lambda one: one.peak)
    # smooth both, or a crystal lattice with less contrast than its shading would fit better in a brighter region
    short, long = (smoothed(image, 1.0) for image in (short, long))
    independent = float(both.sum()) / (4 * np.pi)  # number of independent pixels after the filter
    gain = (information(short, long, second.matrix, both) - information(short, long, first.matrix, both)) / (4 * np.pi)
    if abs(gain) < np.sqrt(independent):
        gain = float(masks[1].sum()) - float(masks[0].sum())
    return second if gain > 0 else first


def _plausible(matrix: Image) -> bool:
    """Whether a transform has no reflection, and no magnification or shear beyond that of drift or two camera settings."""
    singular = np.linalg.svd(matrix[:, :2], compute_uv=False)
    return bool(np.linalg.det(matrix[:, :2]) > 0 and max(singular[0], 1 / singular[1]) < 1.3)


def _turn(matrix: Image, reference: Image | None = None) -> float:
    """Largest relative displacement between two transforms apart from a shift; the default reference is the identity."""
    return float(np.linalg.norm(matrix[:, :2] - (np.eye(2) if reference is None else reference[:, :2]), 2))


def _conclusive(inliers: int, matches: int, *, least: int = 30) -> bool:
    """Whether so many matches agree with a transform, and outnumber the others, that it is accepted.

    A false match agrees within `INLIER_DISTANCE` about once in 5000, while the correlation decreases with the overlap.
    """
    return inliers >= max(least, matches / 2)


def _refined(short: Image, long: Image, guess: Guess, *, largest: float = 0.5) -> Registration | None:
    """Refine a guess with each motion, select one by the Bayesian information criterion, and check it.

    Returns:
        The registration; None if it is rejected, or uncertain by more than the `largest` standard error, pixels.
    """
    sign = 1.0 if correlation_at(short, long, guess.matrix, blur=2.0)[0] >= 0 else -1.0
    found: dict[Motion, Image] = {}
    for motion in MOTIONS:
        matrix = maximise_correlation(short, sign * long, restricted(guess.matrix, motion, short.shape), motion)
        if matrix is not None and _plausible(matrix) and covered(matrix, short.shape).mean() >= MINIMUM_OVERLAP:
            found[motion] = matrix
    if not found:
        return None
    mask = np.logical_and.reduce([covered(matrix, short.shape) for matrix in found.values()])
    # otherwise the motion whose interpolation smooths more would be preferred
    smooth = smoothed(long, 1.0)
    motion = max(
        found, key=lambda name: information(short, smooth, found[name], mask) - MOTIONS[name] * np.log(mask.sum())
    )
    matrix = found[motion]
    fine, coarse = (correlation_at(short, long, matrix, blur=blur) for blur in BANDS)
    peak = max(abs(correlation) / deviation for correlation, deviation in (fine, coarse))
    alike = abs((coarse if guess.method == "unshifted" else fine)[0])
    same = alike >= SAME_SCENE and _turn(matrix) <= LARGEST_TURN and covered(matrix, short.shape).mean() >= 0.5
    error = standard_error(short, long, matrix, motion)
    residual = np.linalg.norm(guess.points[:, 0] @ matrix[:, :2].T + matrix[:, 2] - guess.points[:, 1], axis=1)
    inlier = residual < INLIER_DISTANCE
    proven = peak >= CERTAIN or same or _conclusive(int(inlier.sum()), guess.matches)
    if not proven or error > largest or _turn(matrix, guess.matrix) > LARGEST_TURN:
        return None
    if _turn(matrix) > LARGEST_TURN and _equal_peaks(short, long, matrix):
        return None  # with rotation or magnification, any crystal lattice fits another
    rms = float(np.sqrt(np.mean(residual[inlier] ** 2))) if inlier.any() else error
    return Registration(matrix, motion, guess.method, int(inlier.sum()), guess.matches, rms, error, peak, sign < 0)
