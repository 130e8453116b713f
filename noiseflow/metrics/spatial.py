"""Spatial structure in residuals that a per-pixel noise model cannot describe: row, column and neighbour correlation."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.described import described
from noiseflow.distributions.pixels import require_image
from noiseflow.fitting.stream import without_gaps
from noiseflow.metrics.evaluation import probability_integral_transform
from noiseflow.statistics import neighbour_products


@described()
@dataclass(frozen=True)
class SpatialStructure:
    """Correlations of the standardised residuals of an image, which a per-pixel noise model cannot describe.

    Attributes:
        rows, columns: variance of row and column means relative to that of independent pixels; 1 without structure.
        horizontal, vertical: correlation of neighbouring pixels.
        pattern: correlation of the same pixel in different images of a stack; 0 for a single image.
        error: standard error of the correlations under independence.
        suffices: whether the model suffices: no value deviates by more than four standard errors.
        remedies: model terms that would describe the deviations, most significant first.
    """

    rows: float
    columns: float
    horizontal: float
    vertical: float
    pattern: float
    error: float
    suffices: bool
    remedies: tuple[str, ...] = ()

    def in_words(self) -> str:
        """One-line summary."""
        figures = (
            f"correlation of neighbours {self.horizontal:+.3f} along x and {self.vertical:+.3f} along y (± {self.error:.3f}); "
            f"variance of row means {self.rows:.2f} and of column means {self.columns:.2f} times that of independent pixels"
        )
        if self.pattern:
            figures += f"; correlation of the same pixel in different images {self.pattern:+.3f}"
        if self.suffices:
            return figures + "; a per-pixel model suffices"
        return figures + "; a per-pixel model does not suffice: " + "; ".join(self.remedies)


@torch.no_grad()
def spatial_structure(
    noise_model: nn.Module, signal: Tensor | NDArray[Any], observation: Tensor | NDArray[Any]
) -> SpatialStructure:
    """Row, column, neighbour and fixed-pattern correlation of the residuals of images (y, x), or stacks, under a noise model.
    Masked, NaN and infinite pixels are excluded (their residuals are set to 0). Raises ValueError if these are all, the shapes
    differ, or have one axis."""
    z = _latent(noise_model, signal, observation)
    height, width = z.shape[-2:]
    error = 1 / math.sqrt(z.size)
    rows, columns = float(z.mean(-1).var() * width), float(z.mean(-2).var() * height)
    products = (neighbour_products(z, axis=axis) for axis in (-1, -2))  # of one row there are none along y
    horizontal, vertical = (float(each.sum()) / max(each.size, 1) for each in products)
    stack = z.reshape(-1, height, width)
    pattern = float(neighbour_products(stack, axis=0).mean()) if len(stack) > 1 else 0.0
    shared = _shared(z), _shared(z.swapaxes(-1, -2))
    neighbours = max(abs(horizontal - shared[0]), abs(vertical - shared[1]))
    excess = {
        "ScanNoise(model) adds an offset to each row": shared[0] * math.sqrt(z.size * width) / 2,
        'ScanNoise(model, along="column") adds an offset to each column': shared[1] * math.sqrt(z.size * height) / 2,
        "WithMaps(model, gain, offset) gives every pixel its own gain and offset": pattern / error,
        "Correlated(model, correlation_kernel(model, signal, observation)) correlates neighbours": neighbours / error,
    }
    remedies = sorted((name for name in excess if excess[name] > 4), key=lambda name: -excess[name])
    return SpatialStructure(rows, columns, horizontal, vertical, pattern, error, not remedies, tuple(remedies))


@torch.no_grad()
def correlation_kernel(
    noise_model: nn.Module, signal: Tensor | NDArray[Any], observation: Tensor | NDArray[Any], *, reach: int = 2
) -> Tensor:
    """The kernel for `noiseflow.Correlated` with the correlations that residuals of images (y, x), or stacks, have.

    Residuals are converted to standard normal ones by the noise model. Their power spectrum is the Fourier transform of their
    autocorrelation up to `reach`; the kernel is symmetric and has the square root of that spectrum. Correlations within three
    standard errors of 0 are 0.

    Args:
        noise_model: the noise model of single pixels.
        signal, observation: images of equal shape; NaN and infinite pixels are excluded.
        reach: largest distance of correlated pixels along each axis.

    Raises:
        ValueError: as `spatial_structure`, or `reach` is no whole number of pixels.

    Returns:
        (2·reach + 1, 2·reach + 1) with unit sum of squares, a single 1 at its centre if there is no significant correlation;
        (1, 1) if all residuals are equal.

    Example:
        >>> import noiseflow, torch
        >>> blurred = noiseflow.Correlated(noiseflow.Gaussian(), torch.ones(1, 3))
        >>> signal = torch.zeros(100, 100)
        >>> image = blurred(signal).sample(generator=torch.Generator().manual_seed(0))
        >>> from noiseflow.metrics.spatial import correlation_kernel
        >>> correlation_kernel(noiseflow.Gaussian(), signal, image, reach=1)[1].round(decimals=1)
        tensor([0.6, 0.6, 0.6])
    """
    check(reach=reach)
    z = _latent(noise_model, signal, observation)
    height, width = z.shape[-2:]
    if not z.any():
        return torch.ones(1, 1)
    side, padded = 2 * reach + 1, (height + 2 * reach, width + 2 * reach)
    spectrum = np.abs(np.fft.rfft2(z, s=padded)) ** 2
    products = np.fft.irfft2(spectrum.reshape(-1, *spectrum.shape[-2:]).mean(0), s=padded)
    lags = np.arange(-reach, reach + 1)
    pairs = (height - np.abs(lags)).clip(0)[:, None] * (width - np.abs(lags)).clip(0)
    # no pair is that far apart in a small image
    found = np.where(pairs, products[np.ix_(lags, lags)], 0) / pairs.clip(1)
    found /= found[reach, reach]
    found[np.abs(found) < 3 / math.sqrt(z.size)] = 0
    wide = np.zeros((4 * side, 4 * side))  # the root of a spectrum reaches further than the spectrum
    wide[np.ix_(lags, lags)] = found
    kernel = np.fft.ifft2(np.sqrt(np.fft.fft2(wide).real.clip(0))).real[np.ix_(lags, lags)]
    return torch.from_numpy(kernel / np.sqrt((kernel**2).sum())).float()


def _shared(z: NDArray[np.float64]) -> float:
    """Variance shared by all pixels of a row: the covariance of its halves, hardly affected by neighbour correlation."""
    half = z.shape[-1] // 2
    if half == 0:
        return 0.0
    left, right = z[..., :half].mean(-1), z[..., -half:].mean(-1)
    return float(((left - left.mean()) * (right - right.mean())).mean())


def _latent(noise_model: nn.Module, *images: Any) -> NDArray[np.float64]:
    """Standardised residuals, shaped like the images, signal and observation, standard normal under the model."""
    bad, signal, observation = without_gaps(noise_model, *images)
    require_image(signal, "residuals of neighbours")
    u = probability_integral_transform(noise_model, signal, observation, np.random.default_rng(0))
    z = torch.special.ndtri(torch.from_numpy(u).clamp(1e-6, 1 - 1e-6)).numpy()
    z[bad.cpu().numpy()] = 0
    return np.asarray((z - z.mean()) / (z.std() or 1.0))
