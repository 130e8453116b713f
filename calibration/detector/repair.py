"""Correction of violated assumptions: changed regions, a misfit of the signal, offsets of rows and columns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.detector.correlation import REACH
from calibration.exposures.frames import Image
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import (
    BLUR,
    MOST_PIXELS,
    VarianceLine,
    correlated,
    dilated,
    eroded,
    one_sigma,
    smoothed,
)
from calibration.registration.aligned import MINIMUM_PIXELS, AlignedPair, smooth_signal
from calibration.tolerances import CLEAR, GAIN, SCENE, STANDS_OUT
from noiseflow.described import described
from noiseflow.statistics import rare_chi_squared


@described(share="of the residual's variance")
@dataclass(frozen=True)
class SceneFit:
    """Largest share of the residual variance that follows the scene; zero within `error` if the signal fits.

    Attributes:
        share: share that one cause explains.
        cause: "blur", by gradient and curvature of the scene: blur, drift, motion, magnification; "illumination", by the
            position: light or dose changed across the field; "response", by the square of the signal: one exposure is not linear;
            "mosaic", different for the pixels of a 2 × 2 mosaic: colour filters moved over the scene; "parts", by the quadrant:
            amplifiers with offsets of their own.
        error: a share of `CLEAR` times this is as improbable without a misfit as that of a normal variable.
    """

    share: float
    cause: str
    error: float

    @property
    def clear(self) -> bool:
        """Whether the share is significant."""
        return self.share > CLEAR * self.error


def fit_scene(pair: AlignedPair) -> SceneFit:
    """Regress the residual on derivatives, position and square of the signal.

    The noise of the signal affects both the residual and the regressors; this contribution is known from its variance and
    subtracted.
    """
    residual, mask, smooth = pair.residual, pair.mask, smooth_signal(pair, blur=BLUR)
    chosen = np.flatnonzero(mask)
    chosen = np.random.default_rng(0).choice(chosen, MOST_PIXELS) if len(chosen) > MOST_PIXELS else chosen
    places = np.divmod(chosen, mask.shape[1])
    y, x = (index / max(size - 1, 1) - 0.5 for index, size in zip(places, mask.shape, strict=True))
    signs = [(-1.0) ** place for place in (*places, sum(places))]
    centred = smooth.ravel()[chosen] - smooth[mask].mean()
    base = [np.ones(len(chosen)), smooth.ravel()[chosen]]
    orders = [(0, 1), (1, 0), (0, 2), (1, 1), (2, 0)]  # along y and x: gradient and curvature, which a blur adds
    groups = {
        "blur": [smoothed(smooth, BLUR / 2, order=order).ravel()[chosen] for order in orders],
        "illumination": [x, y, x * centred, y * centred, x * x, y * y, x * y],
        "response": [centred**2],
        "parts": [side := np.sign(x), other := np.sign(y), side * other],
        "mosaic": [sign * term for sign in signs for term in (np.ones(len(chosen)), centred)],
    }
    reach = int(8 * BLUR)
    point = smoothed(np.pad(np.ones((1, 1)), reach), BLUR)
    own = {"blur": [smoothed(point, BLUR / 2, order=order)[reach, reach] for order in orders]}
    scale, z = residual.spread.ravel()[chosen], residual.z.ravel()[chosen]
    shares = {}
    noise = residual.share * len(chosen)  # Σ own variance / variance
    for name, columns in groups.items():
        design = np.stack([*base, *columns]) / scale
        norms = np.sqrt((design**2).sum(1))
        design /= np.maximum(norms[:, None], np.finfo(float).tiny)
        coupled = np.array([0.0, point[reach, reach], *own.get(name, [0.0] * len(columns))]) * noise
        moment = design @ z + coupled / np.maximum(norms, np.finfo(float).tiny)
        gram = design @ design.T + 1e-9 * np.eye(len(design))
        whole = moment @ np.linalg.solve(gram, moment)
        without = moment[:2] @ np.linalg.solve(gram[:2, :2], moment[:2])
        shares[name] = (whole - without - len(columns)) / len(chosen)
    most = max(len(columns) for columns in groups.values())
    error = (rare_chi_squared(CLEAR, most) - most) / CLEAR / len(chosen)  # there is a test for each frame
    cause = max(shares, key=lambda name: shares[name])
    return SceneFit(float(shares[cause]), cause, error)


def changed_places(pair: AlignedPair) -> Mask:
    """Return the (y, x) mask of regions that changed between the exposures, from outliers of the smooth residual."""
    weight, average = (smoothed(one.astype(float), 2 * BLUR) for one in (pair.mask, pair.residual.z))
    smooth = np.divide(average, np.sqrt(weight), out=np.zeros_like(average), where=weight > 0.3)
    spread = float(np.ptp(one_sigma(inside := smooth[pair.mask])) / 2)
    far = np.abs(smooth - np.median(inside)) > STANDS_OUT * max(spread, np.finfo(float).tiny)
    return pair.mask & dilated(far, int(4 * BLUR))


def without_places(pair: AlignedPair, changed: Mask) -> AlignedPair:
    """Exclude regions from a pair and refit its variance line; the pair is unchanged if too few pixels would remain."""
    mask = pair.mask & ~changed
    if mask.sum() < MINIMUM_PIXELS or not changed.any():
        return pair
    total = VarianceLine.fitted(pair.signal[mask], ((pair.short - pair.signal) ** 2)[mask])
    counts = replace(pair.counts, restless=pair.counts.restless + int(changed.sum()))
    return replace(pair, mask=mask, total_variance=total, counts=counts)


def refitted(pair: AlignedPair) -> AlignedPair:
    """Recompute the signal of a pair from the long exposure with a kernel, an illumination and a nonlinear response.

    The kernel, of half-width `REACH`, is the linear filter that best predicts the short exposure. It compensates blur or
    drift of the long exposure, or reproduces that of the short one. The variance of the signal is scaled accordingly.
    """
    mask = eroded(pair.mask, 1) if pair.mask.all() else pair.mask
    chosen = np.flatnonzero(mask)
    chosen = chosen[:: max(1, len(chosen) // MOST_PIXELS)]
    weight = 1 / pair.residual.spread.flat[chosen]
    gram, moment, shapes = _normal_equations(pair, chosen, weight)
    ridge = 1e-8 * np.trace(gram) / len(gram)
    found = np.linalg.solve(gram + ridge * np.eye(len(gram)), moment)
    side = 2 * REACH + 1
    kernel = found[: side * side].reshape(side, side)
    signal = correlated(shapes[0], kernel)
    for coefficient, shape in zip(found[side * side :], shapes[1:], strict=True):
        signal = signal + coefficient * shape
    filtered = replace(pair, kernel=kernel)
    factor = filtered.kept / pair.kept
    own = VarianceLine(factor * pair.signal_variance.floor, factor * pair.signal_variance.rate)
    squares = ((pair.short - signal) ** 2)[pair.mask] * (1 + len(found) / len(chosen))
    return replace(
        filtered, signal=signal, total_variance=VarianceLine.fitted(signal[pair.mask], squares), signal_variance=own
    )


def _normal_equations(pair: AlignedPair, chosen: NDArray[np.int64], weight: Image) -> tuple[Image, Image, list[Image]]:
    """Return the Gram matrix and moments of the shifted signals and the smooth terms, and the images of the terms."""
    middle = float(pair.signal[pair.mask].mean())
    filled = np.where(pair.mask, pair.signal, smooth_signal(pair))
    smooth = smooth_signal(pair) - middle
    y, x = (index / max(size - 1, 1) - 0.5 for index, size in zip(np.indices(smooth.shape), smooth.shape, strict=True))
    shapes = [filled, np.ones_like(smooth), smooth**2 / max(abs(middle), 1.0)]
    shapes += [factor * term for factor in (x, y, x * x, x * y, y * y) for term in (np.ones_like(smooth), smooth)]
    padded = np.pad(filled, REACH, mode="edge")
    height, width = filled.shape
    columns = [
        padded[dy : dy + height, dx : dx + width].ravel()[chosen] * weight
        for dy in range(2 * REACH + 1)
        for dx in range(2 * REACH + 1)
    ]
    design = np.stack([*columns, *(shape.ravel()[chosen] * weight for shape in shapes[1:])])
    return design @ design.T, design @ (pair.short.ravel()[chosen] * weight), shapes


@described(changed="of the pixels", rows="counts", columns="counts", join="counts", joined="of the pixels")
@dataclass(frozen=True)
class Repairs:
    """Violated assumptions that were modelled before the detector was measured.

    Attributes:
        changed: share of pixels in regions that changed between the exposures; they were excluded.
        scene: fit of each pair's signal to the scene before any correction.
        scene_after: the same after a kernel was fitted between the exposures; equal to `scene` if none was.
        refitted: whether a kernel was fitted for any pair.
        rows, columns: standard deviation of the offsets subtracted from rows or columns, counts; 0 if none were.
        join: brightness above which a second converter was used, counts; infinite if none. If few, these pixels are clipped.
        joined: share of pixels above `join`.
    """

    changed: float = 0.0
    scene: tuple[SceneFit, ...] = ()
    scene_after: tuple[SceneFit, ...] = ()
    refitted: bool = False
    rows: float = 0.0
    columns: float = 0.0
    join: float = np.inf
    joined: float = 0.0


def repaired(pairs: Sequence[AlignedPair]) -> tuple[list[AlignedPair], Repairs]:
    """Correct the pairs for violated assumptions; return them and the corrections. `align_burst` has excluded changed regions."""
    offsets = [_without_offsets(pair) for pair in pairs]
    found = [pair for pair, _, _ in offsets]
    changed = [changed_places(pair) if pair.frames == 1 else np.zeros_like(pair.mask) for pair in found]
    share = float(np.mean([mask.sum() / pair.mask.sum() for mask, pair in zip(changed, found, strict=True)]))
    scene = tuple(fit_scene(pair) for pair in found)
    misfits = [one.clear and one.share > SCENE for one in scene]
    if 0 < share < 0.5:  # with half the frame or more, no part of the scene is static
        found = [without_places(pair, mask) for pair, mask in zip(found, changed, strict=True)]
        misfits = [one.clear and one.share > SCENE for one in map(fit_scene, found)]
    found = [refitted(pair) if bad and pair.frames == 1 else pair for pair, bad in zip(found, misfits, strict=True)]
    fitted = [pair for pair, _, _ in offsets]
    after = tuple(
        before if now is then else fit_scene(now) for before, now, then in zip(scene, found, fitted, strict=True)
    )
    rows, columns = (float(np.sqrt(np.mean([deviation[axis] ** 2 for _, *deviation in offsets]))) for axis in (0, 1))
    return found, Repairs(share, scene, after, any(misfits), rows, columns)


def _without_offsets(pair: AlignedPair) -> tuple[AlignedPair, float, float]:
    """Subtract row and column offsets; return the pair and the standard deviations of the offsets, counts; 0 if none."""
    deviations = []
    for axis in (2, 1):
        residual, own = pair.residual, pair.signal_variance
        difference, deviation = without_bands(
            (pair.short - pair.signal)[None], residual.z[None], pair.mask, axis=axis, scene=True
        )
        deviations.append(deviation and deviation * float(np.median(residual.spread[residual.mask])))
        if deviation:
            total = VarianceLine.fitted(pair.signal[pair.mask], (difference[0] ** 2)[pair.mask])
            pair = replace(pair, short=pair.signal + difference[0], total_variance=total, signal_variance=own)
    return pair, deviations[0], deviations[1]


def without_bands(
    residual: Image, z: Image, mask: Mask, *, axis: int, scene: bool = False, shape: Image | None = None
) -> tuple[Image, float]:
    """Subtract significant offsets of rows or columns in single frames, keeping the variance of the noise; return the offsets'
    standard deviation in that of the noise, too, or 0.

    Args:
        residual, z: (N, y, x) counts, from the mean of several frames, and the same over the standard deviation of the noise.
        axis: 2 for rows, 1 for columns.
        scene: whether slow changes from band to band belong to the scene.
        shape: (y, x) factor of the offsets in each pixel: its response, if the light changed; None for 1.
    """
    deviation, error = band_offsets(z, mask, axis=axis, scene=scene)
    if deviation**2 < max(CLEAR * error, GAIN / 2):  # they add their square to the variance
        return residual, 0.0
    factor = np.where(mask, 1.0 if shape is None else shape, 0.0)
    total = np.maximum((factor**2).sum(axis - 1, keepdims=True), 2 * (factor**2).max())
    offset = (residual * factor).sum(axis, keepdims=True) / total
    return (residual - offset * factor) / np.sqrt(1 - factor**2 / total), deviation


def band_offsets(
    z: Image, mask: Mask, *, axis: int, scene: bool, run: int = 16, smooth: int = 9
) -> tuple[float, float]:
    """Return the standard deviation of the offsets of rows or columns, and the standard error of its square without any, from the
    covariance of the means of even and odd runs of pixels along the band; arguments as `without_bands`."""
    frames, size = len(z), z.shape[axis]
    even = np.arange(size) // min(run, -(-size // 4)) % 2 == 0
    halves = np.stack([even, ~even]).astype(float)
    counts = halves @ np.moveaxis(mask, axis - 1, 0)
    known = counts.min(axis=0) >= min(run // 2, size // 3)
    number = int(known.sum()) * frames
    if number < 16:
        return 0.0, 1.0
    sums = np.stack([halves @ np.moveaxis(np.where(mask, one, 0.0), axis - 1, 0) for one in z], axis=1)
    means = (sums / np.maximum(counts, 1)[:, None])[..., known]
    means -= means.mean(axis=-1, keepdims=True)
    freedom = (1 - 1 / frames) if frames > 1 else 1.0
    if scene:
        slow = np.array([np.convolve(one, np.full(smooth, 1 / smooth), mode="same") for one in means.mean(axis=0)])
        means, freedom = means - slow, freedom * (1 - 1 / smooth)
    shared = float(np.mean(means[0] * means[1])) / freedom
    own = np.maximum(np.mean(means**2, axis=(1, 2)) / freedom - shared, 2 / size * np.mean(z[:, mask] ** 2))
    return float(np.sqrt(max(shared, 0.0))), float(np.sqrt(np.prod(own) / number))
