"""Prediction of held-out gaps of tilts by a linear fit, and other geometries: angles or two objects that predict them better."""

from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from noiseflow.checks import LIKELY, Effect, NotTested
from noiseflow.statistics import Array
from recon.projection.projector import joseph
from recon.series.holdout import GAP, Holdout
from recon.verdict.compared import Coarse, neighbours
from recon.verdict.moments import turned
from recon.verdict.tilts import smoothest_order


class GapFit:
    """Least squares with a smoothness prior for one geometry, and its leave-out prediction of every gap.

    For a linear fit y → H y, a fit without the tilts of a gap G predicts them with the error (I − H_GG)⁻¹ (y − H y)_G (the block
    form of Allen's PRESS, doi:10.1080/00401706.1974.10489157), so that no fit is repeated. A constant common to all pixels is
    also fitted: it represents the offset or the logarithm of the incident intensity.

    Args:
        coarse: the geometry; its images are not used.
        smoothness: weight of the squared gradient, relative to the data.
        gap: width of the gaps, degrees.
    """

    def __init__(self, coarse: Coarse, smoothness: float, *, gap: float = GAP) -> None:
        angles, detector_width = np.asarray(coarse.tilt_angles, dtype=np.float64), int(coarse.images.shape[2])
        depth, width, offsets = coarse.depth, coarse.width, np.full(angles.shape, coarse.detector_offset)
        rays, voxels, weights = joseph(angles, offsets, depth, width, detector_width)
        matrix = np.zeros((len(angles) * detector_width, depth * width + 1), np.float32)
        matrix[rays, voxels] = weights
        del rays, voxels, weights
        matrix[:, -1] = np.sqrt(np.mean(matrix[:, :-1].sum(1) ** 2))
        self.detector_width, self.gaps = detector_width, Holdout.gaps(angles, gap).tilts()
        normal = matrix.T @ matrix
        prior = _roughness(depth, width)
        scale = smoothness * float(np.trace(normal[:-1, :-1])) / float(prior.data[prior.row == prior.col].sum())
        normal[prior.row, prior.col] += np.float32(scale) * prior.data
        # symmetric: the transpose has the memory order of LAPACK, which avoids a copy
        factor = linalg.cholesky(normal.T, lower=True, overwrite_a=True, check_finite=False)
        self.half = linalg.solve_triangular(factor, matrix.T, lower=True, overwrite_b=True, check_finite=False)
        parts = (self.half[:, self._rays(tilts)] for tilts in self.gaps)
        free = (np.eye(part.shape[1], dtype=np.float32) - part.T @ part for part in parts)
        self.inverse = [np.asarray(linalg.inv(each, check_finite=False)) for each in free]

    def _rays(self, tilts: Array) -> Array:
        return (tilts[:, None] * self.detector_width + np.arange(self.detector_width)).ravel()

    def fitted(self, images: Array) -> Array:
        """Prediction by the volume of all tilts, (tilt, y, u)."""
        return _to_images(self.half.T @ (self.half @ _to_rays(images)), images.shape)

    def errors(self, images: Array, used: Array | None = None) -> Array:
        """Images minus their prediction by a volume without their gap, (tilt, y, u); zero at pixels that are not `used`."""
        rays = _to_rays(images)
        some = np.ones_like(rays) if used is None else _to_rays(used)
        if not some.all():
            rays = self._completed(rays, some)
        left = rays - self.half.T @ (self.half @ rays)
        result = np.empty_like(left)
        for tilts, inverse in zip(self.gaps, self.inverse, strict=True):
            here = self._rays(tilts)
            result[here] = inverse @ left[here]
        return _to_images(result * some, images.shape)

    def _completed(self, rays: Array, some: Array, *, steps: int = 20) -> Array:
        """Rays whose masked values are those that the fit to the others predicts, so that they do not affect the fit: they solve
        (I − H) y = 0 at the masked rays, by conjugate gradients in every row of the images; with so many `steps`, the rows of a
        border of a fifth differ from the exact fit by less than a thousandth."""
        hidden = 1 - some

        def normal(values: Array) -> Array:
            moved: Array = hidden * (values - self.half.T @ (self.half @ values))
            return moved

        start = rays * some + hidden * ((rays * some).sum(0) / np.maximum(some.sum(0), 1))
        found, residual = start, -normal(start)
        step, power = residual, (residual**2).sum(0)
        for _ in range(steps):
            moved = normal(step)
            size = power / np.maximum((step * moved).sum(0), 1e-30)
            found, residual = found + size * step, residual - size * moved
            power, before = (residual**2).sum(0), power
            step = residual + power / np.maximum(before, 1e-30) * step
        return np.asarray(found)


def shared(images: Array) -> float:
    """Mean product of each pixel with its neighbour along y: power common to rows, which are fitted one by one, without noise."""
    return neighbours(images, 1) if images.shape[1] > 1 else float(np.mean(images**2))


def _roughness(depth: int, width: int, *, ridge: float = 0.02) -> sparse.coo_array:
    """Squared gradient of a (depth, width) slice as a sparse matrix, plus a small ridge for voxels that no ray crosses."""

    def line(size: int) -> Array:
        steps = np.diff(np.eye(size), axis=0)
        return steps.T @ steps

    matrix = sparse.kron(line(depth), sparse.eye_array(width)) + sparse.kron(sparse.eye_array(depth), line(width))
    return sparse.coo_array((matrix + ridge * sparse.eye_array(depth * width)).tocsr().astype(np.float32))


def _to_rays(images: Array) -> Array:
    return np.ascontiguousarray(images.transpose(0, 2, 1).reshape(-1, images.shape[1]), dtype=np.float32)


def _to_images(rays: Array, shape: tuple[int, ...]) -> Array:
    return np.asarray(rays.reshape(shape[0], shape[2], shape[1]).transpose(0, 2, 1))


_SMOOTHNESS = (0.03, 0.3, 1.0)
REPLICATES = 8
"""Series drawn from the fit; the standard error of their standard deviation is a quarter."""
# share of the degrees of freedom, if a fit has nearly as many parameters as data
_LEAST_FREE = 0.1


class Geometry:
    """Prediction of held-out gaps of a coarse series by the given geometry and by others.

    Attributes:
        fit: fit with the given geometry, at the smoothness that predicts gaps best.
        errors: (tilt, y, u) prediction errors of that fit.
        smooth, left: (tilt, y, u) projections of that fit to all tilts, minus the mean of all images, and its residuals.
    """

    def __init__(self, coarse: Coarse) -> None:
        self.coarse = coarse
        least = np.inf
        for smoothness in _SMOOTHNESS:
            fit = GapFit(coarse, smoothness)
            errors = self._errors(fit)
            if (size := float(np.mean(errors**2))) < least:
                least, self.smoothness, self.fit, self.errors = size, smoothness, fit, errors
            del fit, errors  # a fit is larger than the images
        self.smooth = self.fit.fitted(coarse.centred_on_all)
        self.left = (coarse.centred_on_all - self.smooth) * coarse.used

    @cached_property
    def single(self) -> GapFit:
        """The fit that holds out single angles, which their neighbours predict."""
        return GapFit(self.coarse, self.smoothness, gap=self._step)

    @property
    def smooth_single(self) -> GapFit:
        """The same, smooth so that noise hides no odd tilt."""
        usual = _SMOOTHNESS[1]
        return self.single if self.smoothness == usual else GapFit(self.coarse, usual, gap=self._step)

    @property
    def _step(self) -> float:
        """Degrees from one angle to the next."""
        directions = self.coarse.directions
        return directions.span / len(np.unique(np.round(directions.angles, 3)))

    @cached_property
    def replicates(self) -> Array:
        """(replicate, tilt, y, u) series of the given geometry: the fit with its residuals in random signs, the same along rows,
        in which most detectors correlate their noise.

        Residuals are smaller than the noise by the degrees of freedom of the fit.
        """
        count, height, width = self.left.shape
        free = 1 - float((self.fit.half**2).sum()) / (count * width)
        noise = self.left / np.sqrt(max(free, _LEAST_FREE))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(REPLICATES, count, height, 1))
        signs[:, self.coarse.directions.order] = signs.copy()  # so that the order of the tilts changes nothing
        # single precision and one at a time: blocks of tall series leave little memory
        return np.stack([((self.smooth + sign * noise) * self.coarse.used).astype(np.float32) for sign in signs])

    @cached_property
    def fitted_replicates(self) -> list[Array]:
        """The projections of a volume of each."""
        return [self.fit.fitted(images).astype(np.float32) for images in self.replicates]

    def _errors(self, fit: GapFit) -> Array:
        return fit.errors(self.coarse.images, self.coarse.used)

    @property
    def structure(self) -> float:
        """Structure common to neighbouring pixels, in standard errors: the larger value of y and u."""
        flat = self.coarse.centred(self.coarse.images)
        chance = max(float(np.mean(flat**2)) / float(np.sqrt(flat.size)), 1e-30)
        return max(neighbours(flat, axis) for axis in (1, 2)) / chance

    @cached_property
    def turned(self) -> Effect:
        """Images turned so that they explain each other best, as if the tilt axis were elsewhere: each by half of the angle, and
        then on, or back, so that both are interpolated. Half a step off still matches. Low images go on at their edges, where
        they have no structure once they are turned, and none to predict."""
        used, images = self.coarse.used, self.coarse.centred_on_all
        height, width = used.shape[1:]
        if 2 * height < width:
            raise NotTested("the images are lower than half of their width")
        rows = np.clip(np.arange(width) + (height - width) // 2, 0, height - 1)
        given = [np.where(used, each, self.smooth)[:, rows] for each in (images, self.replicates[0])]

        def errors(images: Array) -> Array:
            spread = (images - images.mean(2, keepdims=True)).std() if height < width else 1.0
            return self.fit.errors(images) / max(float(spread), 1e-30)

        def found(degrees: int) -> Effect:
            halves = ((turned(each, degrees / 2), (degrees / 2, -degrees / 2)) for each in given)
            both = ([errors(turned(half, on)) for on in ways] for half, ways in halves)
            gain, chance = (self._gain(on, back, f"{degrees}") for on, back in both)
            return gain._replace(value=gain.value - max(0.0, chance.value))

        return positive(max(found(degrees) for degrees in range(-60, 91, 30) if degrees))

    def rescaled(self, factor: float) -> Effect:
        """All tilt angles times a factor."""
        fit = GapFit(replace(self.coarse, tilt_angles=self.coarse.tilt_angles * factor), self.smoothness)
        return self._beyond_expected(self._errors(fit), fit.errors(self.replicates[0], self.coarse.used), "")

    def reordered(self) -> Effect:
        """The images in the order in which they change least, at the same angles."""
        errors, expected = (self._reordered(each) for each in (self.coarse.images, self.replicates[0]))
        return positive(self._beyond_expected(errors, expected, ""))

    def _reordered(self, images: Array) -> Array:
        """Errors of images, given in rising order of the angles."""
        order = self.coarse.directions.order
        moved, used = np.empty_like(images), np.empty_like(self.coarse.used)
        given = order[smoothest_order(self.coarse.directions.arranged(self.coarse.centred(images)))]
        moved[order], used[order] = images[given], self.coarse.used[given]
        return self.fit.errors(moved, used)

    def two_objects(self) -> Effect:
        """Separate volumes for halves, or for every other tilt; a turned axis that explains more makes them seem apart."""
        order = self.coarse.directions.order
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        parts = {"halves": rank < len(order) // 2, "every other tilt": rank % 2 == 0}
        found = positive(max(self._apart(first, name) for name, first in parts.items()))
        with suppress(NotTested):
            if self.turned.value > max(found.value, LIKELY * self.turned.error):
                found = found._replace(share=0.0)
        return found

    def _apart(self, first: Array, name: str) -> Effect:
        errors, expected = np.empty_like(self.errors), np.empty_like(self.errors)
        for part in (first, ~first):
            coarse, used = replace(self.coarse, tilt_angles=self.coarse.tilt_angles[part]), self.coarse.used[part]
            fit = GapFit(coarse, self.smoothness)
            errors[part] = fit.errors(self.coarse.images[part], used)
            expected[part] = fit.errors(self.replicates[0][part], used)
        return self._beyond_expected(errors, expected, name)

    def _beyond_expected(self, errors: Array, expected: Array, what: str) -> Effect:
        """The gain of another geometry beyond that which it has for a series of the given one: smaller angles and fewer rays make
        any volume smoother, which predicts some objects better."""
        gain = self._gain(errors, self.errors, what)
        chance = self._gain(expected, self.fit.errors(self.replicates[0], self.coarse.used), what)
        return gain._replace(value=gain.value - max(0.0, chance.value))

    def _gain(self, errors: Array, as_given: Array, what: str) -> Effect:
        """Reduction of the errors relative to those as given, with the standard error of a ratio of means over the gaps: those at
        the ends of the range have several times the errors of others, and gain as much more."""
        gaps = self.fit.gaps
        before, after = (np.array([(each[gap] ** 2).mean(dtype=float) for gap in gaps]) for each in (as_given, errors))
        whole = max(float(before.mean()), 1e-30)
        gain = float((before - after).mean()) / whole
        error = float((before - after - gain * before).std(ddof=1) / np.sqrt(len(before))) / whole
        return Effect(gain, error, what)


def positive(effect: Effect) -> Effect:
    """The effect if it is positive, otherwise none."""
    return effect._replace(value=max(0.0, effect.value))
