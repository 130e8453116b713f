"""Scan noise: a random offset for each row or column of an image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution, bisect_quantile
from noiseflow.distributions.numerics.normal import FULL, normal_quadrature
from noiseflow.distributions.numerics.tables import LARGE
from noiseflow.distributions.pixels import PickedSignal, Signal, given_to, require_image, values_of
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.wrapper import ModelAround


class ScanNoise(ModelAround):
    """A noise model plus a Gaussian offset for every row (or column) of an image, as added by scanning.

    The pixel values of a row are independent only given the offset b. The likelihood of a row is therefore
    ∫ N(b; 0, scale²) ∏ p(oᵢ − b | sᵢ) db, computed by quadrature (error 1e-6 nats per row for smooth noise, 1e-3 nats per pixel
    for densities with kinks). ``log_prob`` of a pixel is conditional on the pixel values before it in its row, so that the sum
    over a row is the log-likelihood of the row. ``cdf``, ``icdf``, ``mean`` and ``variance`` are those of single pixel values.

    Args:
        model: the noise model of each pixel; a `Digitised` model rounds and clips after the offset is added.
        scale: standard deviation of the offsets, detector units.
        along: whether each ``"row"`` or each ``"column"`` has an offset.

    Raises:
        ValueError: `scale` is not positive, or the inner model already has offsets.

    Example:
        >>> import noiseflow, torch
        >>> scanned = noiseflow.ScanNoise(noiseflow.Gaussian(0.01), scale=0.1)
        >>> image = scanned(torch.zeros(64, 64)).sample(generator=torch.Generator().manual_seed(0))
        >>> bool(image.mean(dim=1).std() > 5 * image.mean(dim=0).std())  # rows differ, columns do not
        True
    """

    needs_image = True
    settings = ("along",)

    def __init__(self, model: nn.Module, scale: float = 0.1, *, along: Literal["row", "column"] = "row") -> None:
        super().__init__(model)
        check(scale=scale)
        if along not in ("row", "column"):
            raise ValueError(f"along is {along!r}; choose 'row' or 'column'")
        if self.model.shared_axis is not None:
            raise ValueError("the inner model already has row or column offsets; only one such term is supported")
        self.along = along
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    @property
    def axis(self) -> int:
        """The axis of an image along which pixels share an offset."""
        return -1 if self.along == "row" else -2

    @property
    def shared_axis(self) -> int:
        return self.axis

    def forward(self, signal: Signal) -> ScanDistribution:
        """The distribution of images; for selected pixels, those along the last axis share an offset.

        Raises:
            ValueError: the signal is flat.
        """
        require_image(signal, f"every {self.along} of the image has an offset")
        axis = -1 if isinstance(signal, PickedSignal) else self.axis
        return ScanDistribution(self.model(given_to(self.model, signal)), torch.exp(self.log_scale), axis)

    def behind(self, converter: Callable[[NoiseModelBase], NoiseModelBase]) -> ScanNoise:
        """Wrap the inner model in a converter, because offsets are added before rounding and clipping."""
        self.model = converter(self.model)
        return self

    def standardise(self, signal: PickedSignal, observation: Tensor) -> None:
        """Estimate the scale from the means of rows (R, X), and standardise the inner model on the remaining noise."""
        present = torch.isfinite(observation)
        residual = torch.where(present, observation - values_of(signal), torch.zeros_like(observation)).double()
        count = present.sum(-1).clamp(min=1)
        mean = residual.sum(-1) / count
        residual = residual - residual.sum() / present.sum()
        centred = torch.where(present, residual - (residual.sum(-1) / count)[:, None], torch.zeros_like(residual))
        within = (centred.square().sum(-1) / (count - 1).clamp(min=1)).mean()
        chance = (within / count).mean()
        variance = torch.maximum(mean.var(correction=0) - chance, 0.01 * chance)
        share = variance / (variance + chance)
        with torch.no_grad():
            self.log_scale.copy_(variance.sqrt().log())
        left = observation - (share * (mean - mean.mean())).to(observation)[:, None]
        self.model.standardise(given_to(self.model, signal[present]), left[present])

    def without_converter(self) -> ScanNoise:
        return ScanNoise(self.model.without_converter(), math.exp(float(self.log_scale.detach())), along=self.along)

    def extra_repr(self) -> str:
        return f"scale={math.exp(self.log_scale.item()):.4g}, along={self.along}"


class ScanDistribution(DistributionAround):
    """Pixel values that share an offset along an axis.

    Args:
        base: distribution of the pixel values without offsets.
        scale: standard deviation of the offsets.
        axis: the axis along which they are shared, −1 or −2.
    """

    independent = False
    takes_missing = True
    per_pixel = ()

    def __init__(self, base: NoiseDistribution, scale: Tensor, axis: int) -> None:
        super().__init__(base)
        self.scale, self.axis = scale, axis

    def widened(self, value: Tensor, dtype: torch.dtype) -> Tensor:
        return self.base.widened(value, dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density of each pixel value given those before it along the axis; NaN means missing and contributes 0."""
        return self._in_bands(lambda band, part: band._log_prob(*band._before(part)[1:]), value)

    def _before(self, value: Tensor) -> tuple[Tensor, ...]:
        """Offsets, their log-weights, and the log-density of each pixel value at each of them, (Q, ...)."""
        offsets, log_weight = self._offsets(value, whole=True)
        return offsets, log_weight, self._log_prob_at(value, offsets)

    def _log_prob(self, log_weight: Tensor, log_prob: Tensor) -> Tensor:
        total = torch.logsumexp(torch.cumsum(log_prob, self.axis) + log_weight, 0)
        before = torch.logsumexp(log_weight, 0) + torch.zeros_like(total.narrow(self.axis, 0, 1))
        return torch.diff(torch.cat([before, total], self.axis), dim=self.axis)

    def _in_bands(
        self, method: Callable[[ScanDistribution, Tensor], Tensor], value: Tensor, *, pixels: int = 2**13
    ) -> Tensor:
        """The method's result, (..., *value.shape), in bands of whole lines, because it needs a hundred numbers per pixel."""
        across = -1 if self.axis == -2 else -2
        lines = max(1, pixels * value.shape[across] // max(1, value.numel()))
        if lines >= value.shape[across] or not self.base.splits:
            return method(self, value)
        whole, parts, axis = self.expand(value.shape), torch.split(value, lines, across), value.ndim + across

        def band(place: int) -> ScanDistribution:
            return whole.mapped(lambda each, rest: torch.split(each, lines, axis)[place], parts[place].shape)

        return torch.cat([method(band(place), part) for place, part in enumerate(parts)], across)

    def line_log_prob(self, value: Tensor) -> Tensor:
        """Log-likelihood of each whole row (or column), without the shared axis. Faster than the sum of `log_prob`."""
        offsets, log_weight = self._offsets(value, whole=False)
        total = self._log_prob_at(value, offsets).sum(self.axis, keepdim=True)
        return torch.logsumexp(total + log_weight, 0).squeeze(self.axis)

    def conditional(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        log_prob, below, upto = self._in_bands(ScanDistribution._conditional, value)
        return log_prob, below, upto

    def conditional_cdf(self, value: Tensor) -> tuple[Tensor, Tensor]:
        return self.conditional(value)[1:]

    def _conditional(self, value: Tensor) -> Tensor:
        offsets, log_weight, log_prob = self._before(value)
        weight = torch.softmax(torch.cumsum(log_prob, self.axis) - log_prob + log_weight, 0)
        both = self._each(lambda at: torch.stack(at.conditional_cdf(value), 1), offsets)
        return torch.cat([self._log_prob(log_weight, log_prob)[None], (weight[:, None] * both).sum(0)])

    def _each(self, function: Callable[[NoiseDistribution], Tensor], offsets: Tensor) -> Tensor:
        """The function of the distributions with each of the offsets, (Q, ...)."""
        at_once = max(1, LARGE // max(1, self.batch_shape.numel()))
        return torch.cat([function(self._shifted(some)) for some in torch.split(offsets, at_once)])

    def _shifted(self, offset: Tensor) -> NoiseDistribution:
        return self.base.rescaled(torch.ones_like(offset), offset)

    def _log_prob_at(self, value: Tensor, offsets: Tensor) -> Tensor:
        """(Q, ...) log-densities of the pixel values at each of the offsets (Q, ..., 1)."""
        missing = torch.isnan(value)
        safe = torch.where(missing, self.base.mean.detach(), value)
        return torch.where(missing, 0.0, self._each(lambda at: at.log_prob(safe), offsets))

    def _offsets(self, value: Tensor, *, whole: bool) -> tuple[Tensor, Tensor]:
        """Nodes (Q, ..., 1) and log-weights of the integral over the offset, prior included. They are densest around the offset
        of the whole line. Their spacing grows like sinh, either to the full range if `whole`, which the first pixels of the line
        need, or to the range of the line's likelihood."""
        spacing = 0.1 if whole else 0.25
        with torch.no_grad():
            centre, width = self._posterior(value)
            far = (FULL * self.scale + centre.abs()) if whole else FULL * width
            steps = int(torch.asinh(far / width).max() / spacing) + 1 if width.numel() else 1
            t = spacing * torch.arange(-steps, steps + 1).to(centre).view(-1, *(1,) * centre.ndim)
            offsets = centre + width * torch.sinh(t)
            log_step = torch.log(spacing * width * torch.cosh(t))
        scale = self.scale.to(centre.dtype)
        log_prior = -0.5 * (offsets / scale) ** 2 - torch.log(scale) - 0.5 * math.log(2 * math.pi)
        return offsets.to(value.dtype), (log_prior + log_step).to(value.dtype)

    def _posterior(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the offset of each line, given all its pixel values."""
        present = ~torch.isnan(value)
        precision = torch.where(present, 1 / self.base.variance, 0.0)
        residual = torch.where(present, value - self.base.mean, 0.0)
        total = precision.sum(self.axis, keepdim=True) + 1 / self.scale**2
        centre, width = (precision * residual).sum(self.axis, keepdim=True) / total, total**-0.5
        if not bool(torch.isfinite(centre).all()):
            raise ValueError(
                "some signals are NaN or infinite, or some observations infinite, so that whole lines have no likelihood; fill "
                "in the signal, and set missing observations to NaN"
            )
        t = torch.linspace(-2.5, 2.5, 13, dtype=centre.dtype, device=centre.device).view(-1, *(1,) * centre.ndim)
        for _ in range(2):  # for non-Gaussian noise the moment estimate is not the mode
            offsets = centre + width * torch.sinh(t)
            found = self._log_prob_at(value, offsets.to(value.dtype)).sum(self.axis, keepdim=True)
            weight = torch.softmax(found - 0.5 * (offsets / self.scale) ** 2 + torch.log(torch.cosh(t)), 0)
            centre = (weight * offsets).sum(0)
            width = torch.maximum((weight * (offsets - centre) ** 2).sum(0).sqrt(), 0.2 * width)
        return centre, width

    def _average(self, function: Callable[[NoiseDistribution], Tensor]) -> Tensor:
        """Mean over the offsets of a function of the single-pixel distribution."""
        nodes, weights = normal_quadrature(torch.float64, limit=7.0, count=57)
        like = self.scale.detach()
        pairs = zip(nodes.to(like), weights.to(like), strict=True)
        parts = [weight * function(self._shifted((node * self.scale).reshape(1))) for node, weight in pairs]
        return torch.stack(parts).sum(0)

    def cdf(self, value: Tensor) -> Tensor:
        return self._average(lambda distribution: distribution.cdf(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self._average(lambda distribution: distribution.cdf_below(value))

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return torch.log(self._average(lambda distribution: distribution.log_interval_prob(low, high).exp()))

    def icdf(self, value: Tensor) -> Tensor:
        reach = 50 * self.variance.sqrt()
        return bisect_quantile(self.cdf, value, self.mean - reach + 0 * value, self.mean + reach + 0 * value)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw pixel values; every row (or column) of every image has its own offset."""
        return self._shifted(self._draw_offsets(sample_shape, generator)).sample(generator=generator)

    def _draw_offsets(self, sample_shape: Sequence[int], generator: torch.Generator | None) -> Tensor:
        shape = [*torch.Size(sample_shape), *self.batch_shape]
        shape[self.axis] = 1
        return self.scale * torch.randn(shape, generator=generator, dtype=self.scale.dtype, device=self.scale.device)

    def rsample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Differentiable draws; see `NoiseDistribution.rsample`."""
        offset = self._draw_offsets(sample_shape, generator)
        return self.cast(self._shifted(offset).rsample(generator=generator))

    def quadrature(self) -> tuple[Tensor, Tensor]:
        """Not available, because pixels depend on each other.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "pixels that share an offset are not independent; for expectations, entropy and mode without the offset use the "
            "inner model, model.model(signal)"
        )

    @property
    def mean(self) -> Tensor:
        return self._average(lambda distribution: distribution.mean)

    @property
    def variance(self) -> Tensor:
        mean = self.mean
        return self._average(lambda distribution: distribution.variance + (distribution.mean - mean) ** 2)
