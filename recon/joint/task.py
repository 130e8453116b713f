"""A signal model with its training and held-out pixels, also at half or quarter resolution for the first steps of a fit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.fitting.observation_table import ObservationTable, TableKeeper
from recon.fields.occupancy import Occupancy
from recon.joint.signal_model import TomographySignal
from recon.series.holdout import Holdout
from recon.series.views import TILE

BATCH = 4096  # pixels per noise-model step
_TABULATED = 0.05  # nats per pixel
_SIGNALS = 64  # of mean and variance of the noise; sums over the levels of every pixel took longer than the fits


@dataclass
class Task:
    """A signal model and its pixels.

    Attributes:
        observation: (tilt, u, y) pixel values, detector units.
        use: (tilt, u, y) False at excluded pixels; None uses all.
        held_out: (tilt, u, y) True at held-out pixels.
    """

    signal_model: TomographySignal
    observation: Tensor
    use: Tensor | None
    held_out: Tensor
    _tables: dict[nn.Module, TableKeeper] = field(default_factory=dict)

    def tables(self, noise_model: nn.Module) -> TableKeeper:
        """The table of the pixels under a noise model, stored until `forget`."""
        return self._tables.setdefault(noise_model, TableKeeper())

    def forget(self, *noise_models: nn.Module) -> None:
        """Release the tables of noise models that have changed, or are not needed any more."""
        self._tables = {model: table for model, table in self._tables.items() if model not in noise_models}

    @torch.no_grad()
    def signal(self) -> Tensor:
        """The current signal of all pixels, (tilt, u, y)."""
        return self.signal_model.signal().view_as(self.observation)

    @property
    def train(self) -> Tensor:
        """The pixels in use that are not held out."""
        return ~self.held_out if self.use is None else self.use & ~self.held_out

    @property
    def judged(self) -> Tensor:
        """The held-out pixels in use."""
        return self.held_out if self.use is None else self.held_out & self.use

    @torch.no_grad()
    def held_out_log_prob(self, noise_model: nn.Module, signal: Tensor | None = None) -> Tensor:
        """Log-likelihoods of the held-out pixels, (P,), given the current signal or another one."""
        signal = self.signal() if signal is None else signal
        log_prob: Tensor = noise_model(signal[self.judged]).log_prob(self.observation[self.judged])
        return log_prob.double()

    @torch.enable_grad()
    def pull(self, noise_model: nn.Module) -> Tensor:
        """Gradient of the mean log-likelihood of the training pixels by the finest parameters of the volume, flat."""
        *_, finest = self.signal_model.field.parameters()
        signal = self.signal_model.signal().view_as(self.observation)
        log_prob = noise_model(signal[self.train]).log_prob(self.observation[self.train])
        return torch.autograd.grad(log_prob.mean(), finest)[0].flatten()

    @torch.no_grad()
    def blur_of_noise(self, noise_model: nn.Module) -> float:
        """Standard deviation (pixels) of a Gaussian that makes white noise correlate as neighbouring residuals do: exp(−1 / 4σ²).

        The smaller correlation of both directions counts, because noise of rows correlates along them alone. 0 if that of second
        neighbours is nearer to its square, as of misfit, than to its fourth power, as of blurred noise.
        """
        residual = self._standardised(noise_model)[0]
        least, power = 1e-30, float(np.nanmean(residual**2))

        def correlation(distance: int) -> float:
            pairs = ((each[:, distance:], each[:, :-distance]) for each in (residual, residual.swapaxes(1, 2)))
            return min((float(np.nanmean(one * other)) for one, other in pairs if one.size), default=0.0) / power

        near, far = max(correlation(1), least), correlation(2)
        return 0.0 if far > near * near**2 else 0.5 / math.sqrt(max(-math.log(near), least))

    def _standardised(self, noise_model: nn.Module) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Residuals (tilt, u, y) in standard deviations of the noise, and these; NaN without noise, and outside the mask."""
        signal = self.signal().double()
        known = torch.linspace(*torch.aminmax(signal), _SIGNALS, dtype=signal.dtype, device=signal.device)
        found = noise_model(known.to(self.observation))
        mean, variance = (np.interp(signal.cpu(), known.cpu(), each.cpu()) for each in (found.mean, found.variance))
        noisy = variance > 0 if self.use is None else (variance > 0) & self.use.cpu().numpy()  # no counts have no noise
        deviation = np.sqrt(np.where(noisy, variance, np.nan))
        return (self.observation.cpu().numpy() - mean) / deviation, deviation

    @torch.no_grad()
    def bend(self, noise_model: nn.Module) -> tuple[float, float, float]:
        """How much more the response bends than the current one, its standard error, and the line integral of the brightest.

        This is a score test: training pixels are compared with what a bend changes in them beyond all changes of the volume, of
        the signal without an object, and their sum (by conjugate gradients). The error is that of the mean of the tilts, because
        misfit and noise of rows correlate within an image.
        """
        model = self.signal_model
        values: Tensor = model._evaluate()
        lines: Tensor = model.rays(values).view(self.observation.shape)
        with torch.enable_grad():
            at = lines.detach().requires_grad_()
            slope = torch.autograd.grad(model.image_formation(at).sum(), at)[0]
        residual, deviation = (
            torch.from_numpy(each).to(lines).where(self.train, math.nan) for each in self._standardised(noise_model)
        )
        residual, weight = residual.nan_to_num(), (slope / deviation).nan_to_num()
        reach = float(np.quantile(lines.cpu(), 0.999))  # not the largest, which crossing edges may have
        level = weight / weight.norm()

        def seen(change: Tensor) -> Tensor:
            images = weight * model.rays(change * values).view(weight.shape)  # where there is matter
            without: Tensor = images - level * (images * level).sum()
            return without

        change = torch.zeros_like(values, requires_grad=True)
        with torch.enable_grad():
            changed = seen(change)  # linear: one graph serves all iterations

        def back(images: Tensor) -> Tensor:
            with torch.enable_grad():  # of a sum: with a vector, torch would load SymPy
                return torch.autograd.grad((changed * images).sum(), change, retain_graph=True)[0]

        left = weight * lines * (reach - lines) / (2 * reach)
        left = left - level * (left * level).sum()
        direction = found = back(left)
        for _ in range(40):  # after 20, a gyroid shows three quarters of the bend
            images = seen(direction)
            left = left - found.square().sum() / images.square().sum() * images
            found, before = back(left), found
            direction = found + found.square().sum() / before.square().sum() * direction
        by_tilt = (residual * left).double().sum((1, 2)) / left.double().square().sum()
        return float(by_tilt.sum()), float(by_tilt.square().sum().sqrt()), reach

    def blocks(self) -> Tensor:
        """The block of each held-out pixel, whose neighbours have similar errors, (P,)."""
        tilt, u, y = torch.nonzero(self.judged, as_tuple=True)
        return (tilt * self.observation.shape[1] + u // TILE) * self.observation.shape[2] + y // TILE

    @torch.no_grad()
    def tabulates(self, noise_model: nn.Module, signal: Tensor) -> bool:
        """Whether the likelihood of the observations can be tabulated accurately; subsequent fits use the table."""
        observation, ends = self.observation.flatten(), [float(end) for end in torch.aminmax(signal)]
        if self.use is not None:
            observation = torch.where(self.use.flatten(), observation, self.observation[self.use].mean())
        table = self.tables(noise_model).get(lambda _: ObservationTable(noise_model, observation, *ends))
        return table.error < _TABULATED

    def stays_empty(self, noise_model: nn.Module) -> bool:
        """Whether a block without occupied voxels would remain empty, so that fitting it is unnecessary.

        This is the test of `recon.fields.occupancy.Occupancy`: raising any block of voxels increases the likelihood by less than
        its total variation costs.
        """
        model, occupancy = self.signal_model, self.signal_model.occupancy
        if occupancy is None or bool(occupancy.mask.any()):
            return False
        num_train = max(1, int(self.train.sum()))
        lines = torch.zeros_like(self.observation, requires_grad=True)
        signal = model.image_formation(lines)
        slope = torch.empty_like(signal)
        for image, seen, use, result in zip(signal, self.observation, self.train, slope, strict=True):
            shown = image.detach().requires_grad_()  # one by one, because a likelihood needs much memory
            loss = -torch.where(use, noise_model(shown).log_prob(seen), 0.0).sum() / num_train
            (result[...],) = torch.autograd.grad(loss, shown)
        (signal * slope).sum().backward()
        gradient = lines.grad
        if gradient is None or not bool(torch.isfinite(gradient).all()):
            return False
        cost = model.weight / (float(model.field.scale) * model.num_pixels)
        return not bool(occupancy.wants(gradient.view(-1, model.field.height), model.projector, cost).any())

    @contextmanager
    def halved(self) -> Iterator[Task]:
        """The same task at half the resolution, with shared parameters."""
        half = HalfResolution(self.signal_model)
        use = None if self.use is None else half.pixels(self.use)
        yield Task(half.signal_model, half.pixels(self.observation), use, half.pixels(self.held_out))
        half.hand_over()


def gap_mask(held_out: Holdout, like: Tensor) -> Tensor:
    """Mask of pixels (tilt, u, y) to hold out: whole gaps, as neighbours predict single tilts; `like` if they leave none."""
    out = torch.from_numpy(held_out.groups > 0).to(like.device)
    return like if bool(out.all()) else out[:, None, None].expand(like.shape).clone()


def noise_share(images: NDArray[Any]) -> float:
    """Noise of single pixels relative to the contrast.

    This is the mean absolute second difference, small for smooth structure, along all axes of three pixels or more, divided by
    the standard deviation of the images (Immerkær 1996, doi:10.1006/cviu.1996.0060).

    Args:
        images: (tilt, y, u) pixel values; about sixteen images are used.
    """
    some = images[:: max(1, len(images) // 16)]
    axes = [axis for axis, size in enumerate(some.shape[1:]) if size >= 3]
    sums = np.zeros(3)
    for image in some:  # one by one, because sixteen images of a large series take gigabytes
        second = exact = image.astype(np.float64)
        for axis in axes:
            second = np.diff(second, 2, axis)
        sums += np.abs(second).mean(), exact.mean(), exact.var() + exact.mean() ** 2
    size, mean, square = sums / len(some)
    spread, unit = math.sqrt(max(0.0, square - mean**2)), 6 ** (len(axes) / 2) * math.sqrt(2 / math.pi)
    return float(size / spread) / unit if axes and spread > 1e-7 * abs(mean) else math.inf


def block_mask(shape: tuple[int, ...], *, share: float = 0.1, generator: torch.Generator) -> Tensor:
    """Mask of pixels (tilt, u, y) to hold out: whole blocks in every image, so that neighbours do not predict them.

    Args:
        shape: shape of all images.
        share: held-out share of the pixels.
    """
    tilts, width, height = shape
    drawn = torch.rand((tilts, -(-width // TILE), -(-height // TILE)), generator=generator)
    coarse = (drawn < share) | ((drawn == drawn.min()) & (share > 0))  # of a small series one block at least
    return coarse.repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)[:, :width, :height]


class HalfResolution:
    """A signal model on a voxel grid with half the resolution, fitted to every second pixel along u and y.

    Pixels are selected, not binned, so that the likelihood of single pixels applies; clipping would bias the means of bins. The
    first selected pixel alternates between tilts, so that the volume is not shifted. Total variation has the same weight as at
    full resolution, because the numbers of faces and pixels decrease by the same factor: each halving leaves 1/8 of the voxels
    and 1/4 of the pixels. If the number of voxels is odd, the coarse grid is half a pixel too wide at the edges.

    Args:
        signal_model: the signal model at full resolution; image formation and field parameters are shared.

    Attributes:
        signal_model: the signal model at half the resolution.
    """

    @staticmethod
    def times(signal_model: TomographySignal) -> int:
        """How often the resolution can be halved, 0 to 2. Field and projector must support it, and the volume must be large
        enough to benefit."""
        full, field, times = signal_model.projector, signal_model.field, 0
        width = min(full.width, full.detector_width) if full.has_parts else 0
        least = field.halved_from
        while times < len(least) and width >= least[times] and (coarser := field.coarser()) is not None:
            field, times = coarser, times + 1
        return times

    def __init__(self, signal_model: TomographySignal) -> None:
        full, field = signal_model.projector, signal_model.field.coarser()
        if field is None:
            raise ValueError("this signal model has no half resolution; check HalfResolution.times first")
        tilts = np.arange(full.num_tilts)
        # if the width is odd, the last pixel along u is dropped at some tilts; there are as many rows as coarse slices
        self._num_columns, self._first_columns = full.detector_width // 2, tilts % 2
        self._num_rows, self._first_rows = field.height, tilts // 2 % 2 * (signal_model.field.height % 2 == 0)
        projector = full.half(field.depth, field.width, self._num_columns, self._first_columns)
        if projector is None:
            raise ValueError(f"{type(full).__name__} has no half resolution; check HalfResolution.times first")
        self._full, occupancy = signal_model, signal_model.occupancy
        shape = field.depth, field.height, field.width
        changed = {"occupancy": None if occupancy is None else occupancy.coarser(shape)}
        coarser = signal_model.regulariser.at_half_resolution()
        self.signal_model = signal_model.like(field, projector, regulariser=coarser, **changed)

    def pixels(self, images: Tensor) -> Tensor:
        """The selected pixels of images (tilt, u, y)."""
        firsts = zip(images, self._first_columns, self._first_rows, strict=True)
        picked = [image[column::2, row::2][: self._num_columns, : self._num_rows] for image, column, row in firsts]
        return torch.stack(picked)

    def hand_over(self) -> None:
        """Continue at full resolution: the occupancy is restricted to the surroundings of the current volume."""
        coarse, full = self.signal_model, self._full
        if full.occupancy is not None:
            shape = full.field.depth, full.field.height, full.field.width
            found = Occupancy(
                coarse.volume() / coarse.field.scale, shape, least=full.occupancy.least, block=full.occupancy.block
            )
            full.occupancy.mask = found.to(full.occupancy.mask.device).mask
