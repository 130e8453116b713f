"""A fast, converged reconstruction at low resolution, which gives the initial volume and the incident intensity."""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from noiseflow import Gaussian, fit
from noiseflow.fitting.contest import mean_and_error
from noiseflow.resources import num_threads
from recon.fields.fields import Field
from recon.fields.kinds.grids import MultiresolutionField
from recon.joint.signal_model import TomographySignal
from recon.joint.task import noise_share
from recon.projection.base import Projector
from recon.projection.dual_axis import projector_of
from recon.projection.image_formation import Linear, Transmission
from recon.projection.projector import SliceProjector
from recon.series.first_guess import attenuation_scale, estimate_response, rough_volume
from recon.series.masks import binned, detector_offset
from recon.series.tilt_series import TiltSeries, VolumeGrid

_COARSE = 24
_LEAST_BINNING = 4
_HIGHEST_RATE, _RATE = 0.4, 0.6
# Power of SIRT beside the grid relative to that inside, above which a wider grid is tried: it is 0.6 to 3.6 for a truncated slab,
# and below 0.3 for most objects in view. Nats per pixel that the wider grid then has to gain: it gains 0.1 to 0.8 for truncated
# slabs and 0.002 at most for others, such as ice that ends with the field of view.
_MUCH, _WORTH_A_MARGIN = 0.3, 0.02
# vacuum threshold per noise-to-contrast ratio, and its limits: at a ratio of 0.5 or more, vacuum in the coarse volume has a haze
# of 0.2 of the scale; the raw needle (ratio 0.003) has none, and its weak holder, at 0.1, must not be treated as vacuum
_HAZE, _LEAST_VACUUM, _MOST_VACUUM = 0.4, 0.02, 0.2


@dataclass(frozen=True)
class Start:
    """The starting point of the fits of all slices of a series.

    Attributes:
        rough: (z, y, x) coarse volume of all slices, attenuation per voxel of the whole grid.
        response: detector response fitted to that volume.
        height: number of slices of the series.
        noise: noise of single pixels relative to the contrast, see `recon.joint.task.noise_share`.
        margin: voxels beside the grid of the user, on either side, that are fitted too, because the object extends there.
    """

    rough: Tensor
    response: Transmission | Linear
    height: int
    noise: float
    margin: int

    def wide(self, grid: VolumeGrid) -> VolumeGrid:
        """A grid with the margins."""
        return replace(grid, width=grid.width + 2 * self.margin)

    @property
    def vacuum(self) -> float:
        """Attenuation, in units of the scale, below which the coarse volume may be vacuum."""
        return min(max(_HAZE * self.noise, _LEAST_VACUUM), _MOST_VACUUM)

    def rows(self, rows: slice | NDArray[np.int64]) -> Tensor:
        """The coarse volume of some slices, with as many layers along y as there are slices."""
        depth, _, width = self.rough.shape
        stretched = functional.interpolate(self.rough[None, None], (depth, self.height, width), mode="trilinear")
        return stretched[0, 0, :, rows].contiguous()


def start_of(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    *,
    estimate: bool,
    seed: int,
    widen: bool,
    held_out: float = 0.02,
    choices: int = 3,
) -> Start:
    """The starting point for a series, on a grid as wide as the object.

    If the field of view cuts the object off, its outer parts are in the images of some tilts. A volume without them explains
    these by voxels at its edges: a truncated slab at ±60° has 14 dB in place of 19 on a grid of 1.5 times the width. The grid is
    widened as long as the coarse volume then predicts held-out pixels better.

    Args:
        tilt_series, grid: the data and the grid of the user.
        estimate, widen: whether the response may be fitted, and the grid widened.
        held_out: share of the binned pixels that the returned start leaves out. With a tenth, offsets of four seeds differ by 3
            counts on a tilted slab, with a fiftieth by 0.3; the margin is chosen with a tenth, which judges it better.
        choices: most choices of that tenth, as long as two standard errors do not decide. Of 11 tilts of 32 pixels, 70 binned
            pixels judge: ice that ends with the field of view seemed to gain 0.05 nats, and the volume lost 5 dB. A truncated
            slab with 2 counts gains 1.5 to 2.2 errors with one choice, 3 with three.
    """
    noise, step = noise_share(tilt_series.images), grid.width // 4

    def fitted(margin: int, choice: int = 0, **how: Any) -> tuple[Tensor, Start]:
        response = estimate_response(tilt_series, estimate=estimate)
        generator = torch.Generator().manual_seed(seed + choice)
        start = Start(torch.empty(0), response, tilt_series.images.shape[1], noise, margin)
        volume, scores = coarse_start(tilt_series, response, start.wide(grid), generator=generator, **how)
        return scores, replace(start, rough=volume)

    scores = cache(lambda margin, choice, binning: fitted(margin, choice, binning=binning)[0])

    def pays(margin: int) -> bool:
        gain, error, gains = 0.0, math.inf, list[Tensor]()
        binning = _binning(replace(grid, width=grid.width + 2 * margin))  # of both: larger bins have less noise
        while len(gains) < choices and abs(gain - _WORTH_A_MARGIN) < 2 * error:
            wider, known = (scores(each, len(gains), binning) for each in (margin, margin - step))
            gains.append(wider - known)
            gain, error = mean_and_error(torch.cat(gains))
        return gain >= max(_WORTH_A_MARGIN, 2 * error)

    found = fitted(0, held_out=held_out)[1]
    if widen and _extends(tilt_series, grid, step, found.response):
        margin = 0
        while margin < 2 * step and pays(margin + step):
            margin += step
        found = fitted(margin, held_out=held_out)[1] if margin else found
    return found


def _extends(tilt_series: TiltSeries, grid: VolumeGrid, margin: int, response: Transmission | Linear) -> bool:
    """Whether a few iterations of SIRT on a wide grid find much beside the grid."""
    wide = replace(grid, width=grid.width + 2 * margin)
    small, _, projector = _binned(tilt_series, wide, _binning(wide))
    power = rough_volume(small, response, projector).square().mean((0, 1))
    edge = round(len(power) * margin / wide.width)
    return edge > 0 and float(torch.cat([power[:edge], power[-edge:]]).mean()) > _MUCH * float(power[edge:-edge].mean())


def _binning(grid: VolumeGrid) -> int:
    return max(1, min(max(_LEAST_BINNING, round(grid.width / _COARSE)), *(size // 4 for size in grid.shape[1:])))


def coarse_start(
    tilt_series: TiltSeries,
    response: Transmission | Linear,
    grid: VolumeGrid,
    *,
    held_out: float = 0.1,
    num_steps: int = 200,
    binning: int | None = None,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Reconstruct binned images by least squares, and fit the response to them.

    Incident intensity and volume are correlated: a haze looks like a weaker beam. A fit at full resolution moves slowly along
    this valley. Here every step uses the best response for the current volume, and steps are cheap.

    Args:
        tilt_series, grid: the data, and the voxel grid at full resolution.
        response: initial response; set in place, if it is to be fitted.
        held_out: share of the binned pixels to hold out.
        binning: pixels and voxels along each edge of a bin; None for about 24 voxels across. To compare grids, it must be equal.

    Returns:
        The volume, about 24 voxels wide, (z, y, x), attenuation per voxel of `grid`; and the log-likelihoods of the held-out
        pixels, (P,), nats.
    """
    binning = _binning(grid) if binning is None else binning
    small, mask, projector = _binned(tilt_series, grid, binning)
    start = rough_volume(small, response, projector)
    depth, height, width = projector.depth, small.images.shape[1], projector.width
    field = MultiresolutionField((depth, height, width), scale=attenuation_scale(start), coarsest=2)
    field.memory = None  # nearer to the minimum, a haze lowers the offset (fibres: by 2.3 of 10, and 0.8 dB)
    field.start_from(start)
    images, use = (torch.from_numpy(np.ascontiguousarray(array.transpose(0, 2, 1))) for array in (small.images, mask))
    rate = learning_rate(start, field)
    response_now = _BestResponse(response, images, use) if response.vacuum.requires_grad else response
    signal_model = TomographySignal(field, projector, response_now, weight=0.1, learning_rate=rate)
    judged = torch.rand(images.shape, generator=generator) < held_out
    with num_threads(1):  # operations on 24³ voxels
        options: dict[str, Any] = {"digitise": False, "held_out": judged, "generator": generator}
        noise_model, fitted = Gaussian(), use & ~judged
        with torch.no_grad():
            noise_model.standardise(signal_model.signal().view_as(images)[fitted], images[fitted])
        # from the rough volume on, or the noise would count as unknown: wider, it leaves a haze where vacuum could be skipped
        fit(noise_model, signal_model, images, mask=use, num_steps=num_steps, standardise=False, **options)
        with torch.no_grad():
            judged, signal = judged & use, signal_model.signal().view_as(images)
            scores: Tensor = noise_model(signal[judged]).log_prob(images[judged])
    return field.volume() / binning, scores.double()


def learning_rate(volume: Tensor, field: Field) -> float:
    """Learning rate for the thickness of the object, because steps of all voxels along a ray add up in its line integral."""
    thickness = float(volume.mean() / field.scale) * field.depth
    return min(_HIGHEST_RATE, _RATE / math.sqrt(max(thickness, 1e-6)))


class _BestResponse(nn.Module):
    """A response that is fitted to the images at every evaluation of the line integrals."""

    def __init__(self, response: Transmission | Linear, images: Tensor, use: Tensor) -> None:
        super().__init__()
        self.response, self.images, self.use = response, images, use

    def forward(self, line_integrals: Tensor) -> Tensor:
        self.response.match(line_integrals, self.images, self.use)
        signal: Tensor = self.response(line_integrals)
        return signal


def _binned(tilt_series: TiltSeries, grid: VolumeGrid, binning: int) -> tuple[TiltSeries, NDArray[np.bool_], Projector]:
    """The binned series with a mask, and the projector of a grid with voxels of that size."""
    small = binned(tilt_series, binning, binning)
    if tilt_series.axes is not None:  # incomplete bins shift the centre by less than half a bin
        grid = VolumeGrid(-(-grid.depth // binning), *small.images.shape[1:])
        return replace(small, beam=None), small.used, projector_of(small, grid)
    projector = SliceProjector(
        tilt_angles=tilt_series.tilt_angles,
        depth=-(-grid.depth // binning),
        width=-(-grid.width // binning),
        detector_width=small.images.shape[2],
        detector_offset=detector_offset(tilt_series, binning),
    )
    return replace(small, beam=None), small.used, projector
