"""What is compared: images and expected images of a volume, binned series as line integrals, and what a result says of itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised
from noiseflow.checks import Effect, NotTested
from noiseflow.models.wrapper import as_noise_model
from noiseflow.statistics import Array, neighbour_products
from recon.projection.image_formation import Linear, Transmission
from recon.series.alignment import Alignment
from recon.series.first_guess import LEAST_SHARE, contrast_slab, estimate_response
from recon.series.masks import WIDTH, binned, detector_offset
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.series.views import AROUND, Directions

_MOST_PIXELS = 4_000_000  # of a large series, only the slices with the highest contrast are used

Fitted = Transmission | Linear | None


@dataclass(frozen=True)
class Coarse:
    """Line integrals of a coarse series.

    Attributes:
        images: (tilt, y, u) line integrals, in coarse voxels.
        used: (tilt, y, u) True for pixels to use.
        tilt_angles: (tilt,) degrees.
        tilts: (tilt,) indices of these tilts in the whole series.
        binning: binning factor.
        depth, width: coarse voxels.
        detector_offset: offset due to incomplete bins at the far edge, coarse pixels.
    """

    images: Array
    used: Array
    tilt_angles: Array
    tilts: Array
    binning: int
    depth: int
    width: int
    detector_offset: float

    @cached_property
    def directions(self) -> Directions:
        """The tilts as directions modulo 180°."""
        return Directions.of(self.tilt_angles)

    def arranged(self, images: Array | None = None) -> Array:
        """Its images, or others (tilt, y, u), zero where masked, by rising direction, mirrored where necessary."""
        return self.directions.arranged((self.images if images is None else images) * self.used)

    def centred(self, images: Array) -> Array:
        """Images (tilt, y, u) minus the mean of their used pixels; zero where masked."""
        count = np.maximum(self.used.sum((1, 2), keepdims=True), 1)
        return np.asarray((images - (images * self.used).sum((1, 2), keepdims=True) / count) * self.used)

    @property
    def centred_on_all(self) -> Array:
        """(tilt, y, u) images minus the mean of all used pixels; zero where masked."""
        return np.asarray((self.images - self.images[self.used].mean()) * self.used)


def coarse_series(
    tilt_series: TiltSeries, grid: VolumeGrid, fitted: Fitted = None, *, width: int = WIDTH, most: int = 90
) -> Coarse:
    """The series as line integrals, at most `width` pixels wide; of more than the `most` tilts, every second, third … is used,
    because neighbours add no information at this width."""
    stride = -(-tilt_series.num_tilts // most)
    tilts = np.sort(Directions.of(tilt_series.tilt_angles).order[::stride])
    some = tilt_series.select(tilts)
    binning = -(-tilt_series.images.shape[2] // width)
    binning = max(1, min(binning, tilt_series.images.shape[1]))
    images, used = line_integrals(some, some.images, binning, fitted)
    return Coarse(
        images,
        used,
        some.tilt_angles,
        tilts,
        binning,
        max(1, -(-grid.depth // binning)),
        max(1, -(-grid.width // binning)),
        detector_offset(some, binning),
    )


def line_integrals(tilt_series: TiltSeries, images: Array, binning: int, fitted: Fitted = None) -> tuple[Array, Array]:
    """Images (tilt, y, u), binned and converted to line integrals with the estimated response of the series, and their mask."""
    small = binned(tilt_series.with_images(images, tilt_series.mask), binning, binning)
    return inverted(tilt_series, small.images, fitted), small.used


def inverted(tilt_series: TiltSeries, images: Array, fitted: Fitted = None) -> Array:
    """Line integrals of images of a series by its estimated response, bent as the `fitted` one; dark values are clipped, so that
    noise does not become infinite."""
    response = estimate_response(tilt_series)
    if fitted is not None:
        response.bend.copy_(fitted.bend)
        response.reach.copy_(fitted.reach)
    given = torch.from_numpy(np.asarray(images, dtype=np.float32))
    with torch.no_grad():
        if isinstance(response, Transmission):
            given = torch.maximum(given, (LEAST_SHARE * response.intensity.reshape(-1, 1, 1)).expand(given.shape))
        return np.asarray(response.invert(given).numpy())


@dataclass(frozen=True)
class Residuals:
    """Images and projections of the slices with the highest contrast, sorted by tilt angle.

    Attributes:
        images, projections: (tilt, y, u) detector units, equal where masked; their difference is `residual`.
        used: (tilt, y, u) True for pixels to use.
        tilt_angles: (tilt,) degrees, ascending.
        height: (y,) pixels from the centre of the whole images.
    """

    images: Array
    projections: Array
    residual: Array
    used: Array
    tilt_angles: Array
    height: Array

    @classmethod
    def of(cls, tilt_series: TiltSeries, projections: Array | Callable[[slice], Array]) -> Residuals:
        """The residuals of a series, from projections (tilt, y, u) of its volume, or a function that returns some rows."""
        count, height, width = tilt_series.images.shape
        rows = contrast_slab(tilt_series, max(8, _MOST_PIXELS // (count * width)))
        order = np.argsort(tilt_series.tilt_angles, kind="stable")
        images = tilt_series.images[order, rows].astype(np.float32)
        of_rows = projections(rows) if callable(projections) else projections[:, rows]
        predicted = np.asarray(of_rows[order], dtype=np.float32)
        used = np.ones(images.shape, np.bool_) if tilt_series.mask is None else tilt_series.mask[order, rows]
        images = np.where(used, images, predicted)
        position = np.arange(height, dtype=np.float32)[rows] - (height - 1) / 2
        return cls(images, predicted, images - predicted, used, tilt_series.tilt_angles[order], position)

    @property
    def contrast(self) -> float:
        """Standard deviation of the projections."""
        return float(self.projections[self.used].std())

    def shared(self) -> float:
        """Largest mean product of neighbouring residuals, along y, u or the tilts, relative to the variance of the projections.

        Misfit of volume and alignment is shared, independent noise is not; a correlation alone would not say how large it is.
        """
        products = (neighbours(self.residual, axis) for axis in (0, 1, 2))
        return max(map(abs, products)) / max(self.contrast**2, 1e-30)


def above_vacuum(tilt_series: TiltSeries, seen: Residuals, *, faint: float = 0.2) -> tuple[Array, Array, Effect]:
    """(tilt, y, u) residuals as line integrals; their (tilt,) mean in the vacuum, where projections are `faint`;
    and its deviation over the tilts relative to the mean signal. Raises `NotTested` if images show no vacuum."""
    lines = inverted(tilt_series.select(tilt_series.rising), seen.projections)
    lines = lines - lines.min()
    vacuum = seen.used & (lines < faint * lines.max())
    count = vacuum.sum((1, 2))
    if count.min() < AROUND:
        raise NotTested("single images show no vacuum")
    left = seen.residual if tilt_series.mode == "linear" else -seen.residual / seen.projections
    level, noise = (left * vacuum).sum((1, 2)) / count, np.mean(((left * vacuum) ** 2).sum((1, 2)) / count**2)
    chance = float(noise * np.sqrt(2 / len(level)))
    variance, mean = max(float(level.var() - noise), chance), float(lines.mean())
    return left, level, Effect(variance**0.5 / mean, chance / 2 / variance**0.5 / mean)


def neighbours(images: Array, axis: int) -> float:
    """Mean product of neighbouring pixels of (tilt, y, u) images along an axis; zero if the axis has one pixel."""
    products = neighbour_products(images, axis=axis)
    return float(np.mean(products)) if products.size else 0.0


class Result(Protocol):
    """The parts of a reconstruction that are assessed; every method provides them."""

    @property
    def volume(self) -> Volume: ...
    @property
    def projections(self) -> NDArray[np.float32]: ...
    @property
    def fit_result(self) -> Any: ...
    @property
    def noise_model(self) -> nn.Module | None: ...


def expected_images(result: Result, rows: slice = slice(None), *, count: int = 256) -> NDArray[np.float32]:
    """Means of the noise model at the projections (tilt, y, u) of some rows, interpolated between a `count` of signals; the
    projections if there is no noise model."""
    model: nn.Module | None = getattr(result, "noise_model", None)
    projections = np.asarray(result.projections, dtype=np.float32)[:, rows]
    if model is None:
        return projections
    low, high = float(projections.min()), float(projections.max())
    if not high > low:
        return projections
    levels = torch.linspace(low, high, count, device=as_noise_model(model).device)
    with torch.no_grad():
        means = _unrounded(model, levels)(levels).mean.double().cpu().numpy()
    if not np.isfinite(means).all():
        return projections
    places = np.linspace(low, high, count)
    return np.stack([np.interp(image, places, means).astype(np.float32) for image in projections])


def _unrounded(model: nn.Module, levels: Tensor) -> nn.Module:
    """The model without rounding that is too fine to affect the mean, because summing over many levels is slow."""
    if not isinstance(model, Digitised) or model.levels.numel():
        return model
    fine = model.step < float(levels[1] - levels[0]) or model.step**2 < float(model.model(levels).variance.median())
    return Digitised(model.model, 0.0, model.low, model.high) if fine else model


def jump(fit_result: Any) -> Effect:
    """Held-out likelihood at the end minus the best before, nats per pixel."""
    history = [] if fit_result is None else [float(value) for value in dict(fit_result.history).values()]
    if not history:
        return Effect(0.0)
    return Effect(history[-1] - min(history) if all(math.isfinite(value) for value in history) else 1e3)


def weight_at_end(tried: dict[float, float]) -> Effect:
    """1 if the best of the tried weights is the largest, −1 if it is the smallest: a better one may be outside."""
    if len(tried) < 2:
        return Effect(0.0)
    best = min(tried, key=lambda weight: tried[weight])
    end = (best == max(tried)) - (best == min(tried))
    return Effect(end, what=f"{'above the highest' if end > 0 else 'below the lowest'} one tried, {best:.2g}")


def other_axis(alignment: Alignment | None) -> Effect:
    """Two standard errors over the lead of the tilt axis: a smaller lead has a probability of 1 in 40 by chance."""
    if alignment is None or alignment.margin is None:
        return Effect(0.0)
    return Effect(2 / max(alignment.margin, 0.1), what=f"{alignment.margin:.1f}")
