"""Noise that correlates between neighbouring pixels, as after a blur of the detector, resampling or interpolation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.arrays import floating
from noiseflow.distributions.noise_distribution import NoiseDistribution, RescaledDistribution
from noiseflow.distributions.numerics.normal import normal_cdf
from noiseflow.distributions.pixels import Signal
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.wrapper import ModelAround


class Correlated(ModelAround):
    """A noise model whose samples correlate between neighbouring pixels.

    White normal noise is filtered with a kernel, and each pixel of the result is converted to a quantile of the inner model (a
    Gaussian copula, doi:10.1017/S0266466604206054). Single pixels therefore keep exactly the law of the inner model, whatever
    that is, and neighbours have the correlation of the kernel. ``log_prob`` is that of single pixels; `effective_share` says how
    much less many of them tell together.

    Args:
        model: the noise model of single pixels.
        kernel: (2j + 1, 2i + 1) filter along y and x, any scale, see `noiseflow.metrics.spatial.correlation_kernel`; no
            correlation by default.
        shape: size of the kernel, if it is not given.

    Raises:
        ValueError: the kernel has an even side, is zero or not finite, or pixels of a line share an offset under the inner model.

    Example:
        >>> import noiseflow, torch
        >>> blurred = noiseflow.Correlated(noiseflow.Poisson(), torch.ones(1, 3))
        >>> image = blurred(torch.full((200, 200), 10.0)).sample(generator=torch.Generator().manual_seed(0))
        >>> along, down = (torch.corrcoef(torch.stack([a.reshape(-1), b.reshape(-1)]))[0, 1] for a, b in (
        ...     (image[:, 1:], image[:, :-1]), (image[1:], image[:-1])))
        >>> round(along.item(), 1), abs(round(down.item(), 1)), round(image.var().item())
        (0.7, 0.0, 10)
    """

    kernel: Tensor

    def __init__(
        self, model: nn.Module, kernel: Tensor | NDArray[Any] | None = None, *, shape: Sequence[int] = (1, 1)
    ) -> None:
        super().__init__(model)
        if self.model.shared_axis is not None:
            raise ValueError("pixels of a line share an offset, which no kernel has; put ScanNoise around Correlated")
        given = torch.zeros(tuple(shape)) if kernel is None else floating(kernel).detach().clone()
        if given.ndim != 2 or any(size % 2 == 0 for size in given.shape):
            raise ValueError(f"the kernel has shape {tuple(given.shape)}; give two odd sides, such as 3 x 3")
        if kernel is None:
            given[given.shape[0] // 2, given.shape[1] // 2] = 1
        elif not 0 < float(given.square().sum()) < math.inf:
            raise ValueError("the kernel is zero, or not finite; give a filter such as torch.ones(3, 3)")
        else:
            given /= given.square().sum().sqrt()
        self.register_buffer("kernel", given)

    def forward(self, signal: Signal) -> NoiseDistribution:
        return CorrelatedDistribution(self.model(signal), self.kernel)

    @property
    def effective_share(self) -> float:
        """Number of independent pixels with the same information on a smooth signal, per pixel: the inverse sum of the
        correlations of a pixel with all others, at most 1."""
        return min(1.0, 1 / max(float(self.kernel.sum()) ** 2, 1e-30))

    def standardise(self, signal: Signal, observation: Tensor) -> None:
        """Standardise the inner model."""
        self.model.standardise(signal, observation)

    def without_converter(self) -> NoiseModelBase:
        return Correlated(self.model.without_converter(), self.kernel)

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model, without the inner model and the kernel."""
        return {"shape": list(self.kernel.shape)}

    def extra_repr(self) -> str:
        return f"kernel of {' x '.join(map(str, self.kernel.shape))} pixels"


class CorrelatedDistribution(RescaledDistribution):
    """Pixel values with the laws of another distribution, drawn with correlated quantiles.

    Args:
        base: distribution of single pixels.
        kernel: (2j + 1, 2i + 1) filter with unit sum of squares.
    """

    independent = False

    def __init__(self, base: NoiseDistribution, kernel: Tensor) -> None:
        one = torch.ones((), dtype=base.working_dtype, device=base.device)
        super().__init__(base, one, torch.zeros_like(one))
        self.kernel = kernel

    def mapped(self, take: Any, shape: torch.Size) -> CorrelatedDistribution:
        return CorrelatedDistribution(self.base.mapped(take, shape), self.kernel)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw images. Raises ValueError if the signal is flat."""
        shape = torch.Size([*sample_shape, *self.batch_shape])
        if len(self.batch_shape) < 2:
            raise ValueError(f"neighbouring pixels correlate: give signals as images (..., y, x), not {tuple(shape)}")
        padded = [size + side - 1 for size, side in zip(shape[-2:], self.kernel.shape, strict=True)]
        options: dict[str, Any] = {"dtype": torch.float64, "device": self.device}
        white = torch.randn([math.prod(shape[:-2]), 1, *padded], generator=generator, **options)
        quantile = normal_cdf(functional.conv2d(white, self.kernel.to(white)[None, None])).view(shape)
        with torch.no_grad():
            return self.base.icdf(quantile.clamp(max=1 - np.finfo(np.float64).eps / 2))
