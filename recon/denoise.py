"""Denoisers of single images as functions from image to image, for methods that denoise before reconstruction.

Signal-dependent noise is first stabilised to unit standard deviation. The generalised Anscombe transform
(doi:10.1109/TIP.2012.2202675) stabilises a variance that is linear in the signal. The exact unbiased inverse is the clean signal
whose *expected* stabilised value is the given one; the algebraic inverse is biased.
"""

import math
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its packages load when they are first used
import torch
from skimage import restoration
from torch import nn

from noiseflow.installation import install_command
from noiseflow.models.wrapper import as_noise_model
from noiseflow.statistics import Array, bulk

Denoiser = Callable[[Array], Array]
_STRENGTHS = [2 ** (k / 2) for k in range(-2, 3)]


def non_local_means(image: Array, strength: float) -> Array:
    """Non-local means (doi:10.1109/CVPR.2005.38) of an image (y, x) with unit noise; `strength` scales the filter."""
    options = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "sigma": 1.0}
    return np.asarray(restoration.denoise_nl_means(image, h=0.8 * strength, **options))


def total_variation(image: Array, strength: float) -> Array:
    """Chambolle's total variation (doi:10.1023/B:JMIV.0000011325.36760.1e) of an image with unit noise."""
    return np.asarray(restoration.denoise_tv_chambolle(image, weight=strength))  # type: ignore[no-untyped-call]


def wavelet(image: Array, strength: float) -> Array:
    """BayesShrink wavelet soft thresholding (doi:10.1109/83.862633), averaged over shifts, for noise of `strength`."""
    options = {"sigma": strength, "method": "BayesShrink", "mode": "soft", "wavelet": "db2"}
    return np.asarray(
        restoration.cycle_spin(image, func=restoration.denoise_wavelet, max_shifts=3, func_kw=options, workers=1)
    )


def wiener(image: Array, strength: float) -> Array:
    """Wiener–Kolmogorov filter of an image with white noise of standard deviation `strength`.

    The signal power is the radially averaged periodogram of the mirrored image minus that of the noise, clipped at zero.
    """
    mean = image.mean()
    mirrored = np.pad(image - mean, [(0, size) for size in image.shape], mode="symmetric")
    spectrum = np.fft.rfft2(mirrored)
    power = np.abs(spectrum) ** 2 / mirrored.size
    rows, columns = np.fft.fftfreq(mirrored.shape[0])[:, None], np.fft.rfftfreq(mirrored.shape[1])
    ring = np.rint(np.hypot(rows, columns) * min(mirrored.shape)).astype(int)
    total = np.bincount(ring.ravel(), power.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    gain = np.maximum(1 - strength**2 / np.maximum(total, 1e-30), 0)[ring]
    filtered = np.fft.irfft2(spectrum * gain, s=mirrored.shape)
    return np.asarray(filtered[: image.shape[0], : image.shape[1]] + mean)


def bm3d(image: Array, strength: float) -> Array:
    """BM3D (doi:10.1109/TIP.2007.901238) for noise of `strength`, from the package `bm3d` (non-commercial licence)."""
    try:
        import bm3d as package
    except ModuleNotFoundError:
        raise ValueError(f"denoiser bm3d needs {install_command('bm3d')} (non-commercial use only)") from None
    return np.asarray(package.bm3d(image, sigma_psd=strength))


DENOISERS: dict[str, Callable[[Array, float], Array]] = {
    "nlm": non_local_means,
    "tv": total_variation,
    "wavelet": wavelet,
    "wiener": wiener,
    "bm3d": bm3d,
}
"""Denoisers by name: functions of an image (y, x) with noise of unit standard deviation, and of a strength near 1."""


def find_denoiser(name: str, images: Array, *, noise_model: nn.Module | None = None) -> Denoiser:
    """Return a denoiser for the images of one series: a function from image (y, x) to image.

    The noise is first stabilised to unit standard deviation, by the noise model if one is given, otherwise by an estimated line
    of variance against signal; the exact unbiased inverse is applied to the result. The strength is chosen by self-supervision
    (J-invariance, arXiv:1901.11365) on the middle image.

    Args:
        name: one of `DENOISERS`, or your own function as ``package.module:function``, which receives the original images.
        images: (image, y, x) noisy pixel values, detector units.
        noise_model: noise model fitted to such images.

    Raises:
        ValueError: the name is unknown, or its package is not installed.
    """
    if ":" in name:
        return _of_user(name)
    if name not in DENOISERS:
        raise ValueError(f"denoiser '{name}': choose one of {', '.join(DENOISERS)}, or package.module:function")
    stabiliser = estimated_stabiliser(images) if noise_model is None else stabiliser_of(noise_model, images)
    function = DENOISERS[name]
    middle = stabiliser.forward(np.asarray(images[len(images) // 2], dtype=np.float64))
    strength = 1.0 if name == "bm3d" else best_strength(function, middle)

    def denoise(image: Array) -> Array:
        stabilised = stabiliser.forward(np.asarray(image, dtype=np.float64))
        return stabiliser.inverse(function(stabilised, strength)).astype(np.float32)

    return denoise


def best_strength(function: Callable[[Array, float], Array], image: Array, *, side: int = 128) -> float:
    """The strength whose J-invariant result, which predicts each pixel from the others, is closest to the middle of the image.

    With 128 pixels along each `side`, the mean of the squared errors of unit noise is known to √2/128, about 1 %.
    """
    rows, columns = (slice(max(0, (n - side) // 2), (n + side) // 2) for n in image.shape)
    crop = image[rows, columns]
    options = {"denoise_parameters": {"strength": _STRENGTHS}, "approximate_loss": False, "extra_output": True}
    _, (_, errors) = restoration.calibrate_denoiser(crop, function, **options)  # type: ignore[no-untyped-call]
    finite = {strength: error for strength, error in zip(_STRENGTHS, errors, strict=True) if math.isfinite(error)}
    return min(finite, key=lambda strength: finite[strength], default=1.0)


def _of_user(name: str) -> Denoiser:
    try:
        function = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"denoiser {name}: cannot be imported ({error}); give package.module:function") from error

    def denoise(image: Array) -> Array:
        try:
            result = np.asarray(function(image), dtype=np.float64)
        except Exception as error:  # user code may raise anything
            problem = f"it failed on an image of shape {image.shape} with {type(error).__name__} ({error})"
            raise ValueError(f"denoiser {name}: {problem}; it must take an image and return one") from error
        if result.shape != image.shape or not np.isfinite(result).all():
            raise ValueError(f"denoiser {name} must return finite images of shape {image.shape}, not {result.shape}")
        return result.astype(np.float32)

    return denoise


_LEVELS = 256


@dataclass(frozen=True)
class Stabiliser:
    """An increasing map under which the noise has unit standard deviation, and its exact unbiased inverse, as tables.

    Attributes:
        pixel_values, stabilised: (N,) the map of pixel values.
        signals, expected: (N,) the mean of the stabilised value at each clean signal, increasing.
    """

    pixel_values: Array
    stabilised: Array
    signals: Array
    expected: Array

    def forward(self, image: Array) -> Array:
        """Stabilise pixel values of any shape, so that the noise has unit standard deviation."""
        return _extended(image, self.pixel_values, self.stabilised)

    def inverse(self, image: Array) -> Array:
        """Convert denoised stabilised values to clean signals, detector units, within the range of the table."""
        return np.interp(image, self.expected, self.signals)


def stabiliser_of(noise_model: nn.Module, images: Array) -> Stabiliser:
    """The stabiliser of a fitted noise model, for images in its units.

    The map is ∫ ds / σ(s) over the model's own standard deviation; for Poisson–Gaussian noise that is the generalised Anscombe
    transform. The inverse uses the model's quantiles, so that it accounts for skewness, rounding and clipping.

    Args:
        noise_model: called with signals, returns distributions with ``variance`` and ``icdf``.
        images: the noisy pixel values, any shape; they determine the range of signals.
    """
    low, high = bulk(images)
    margin = 0.05 * (high - low)
    signals = torch.linspace(low - margin, high + margin, _LEVELS, device=as_noise_model(noise_model).device)
    with torch.no_grad():
        variance = noise_model(signals).variance.double().cpu().numpy()
        probabilities = ((torch.arange(2 * _LEVELS).to(signals) + 0.5) / (2 * _LEVELS))[:, None].expand(-1, _LEVELS)
        pixel_values = noise_model(signals.expand(2 * _LEVELS, -1)).icdf(probabilities).double().cpu().numpy()
    deviation = np.sqrt(np.maximum(variance, 1e-4 * np.median(variance)))
    at = signals.double().cpu().numpy()
    stabilised = np.concatenate([[0.0], np.cumsum(np.diff(at) * (1 / deviation[1:] + 1 / deviation[:-1]) / 2)])
    return Stabiliser(at, stabilised, at, _increasing(_extended(pixel_values, at, stabilised).mean(0)))


def anscombe(gain: float, offset: float, read_noise: float, images: Array) -> Stabiliser:
    """The generalised Anscombe transform of pixel values gain·Poisson + N(offset, read_noise²). Raises ValueError if the gain
    is not positive.

    Args:
        gain: detector units per electron.
        read_noise: standard deviation at zero dose, detector units.
        images: the noisy pixel values, any shape; they determine the range of signals.
    """
    if not gain > 0:
        raise ValueError(f"gain {gain} must be positive")
    reach = bulk(images)[1] - offset + 4 * gain
    rates = np.linspace(0, math.sqrt(max(reach / gain, 1.0)), _LEVELS) ** 2
    nodes = scipy.stats.norm.ppf((np.arange(33) + 0.5) / 33)
    uniform = (np.arange(2 * _LEVELS) + 0.5) / (2 * _LEVELS)
    electrons = scipy.stats.poisson.ppf(uniform[:, None], rates[None])
    pixel_values = (gain * electrons + offset)[None] + (read_noise * nodes)[:, None, None]
    lowest, highest = float(pixel_values.min()), max(float(pixel_values.max()), float(images.max()))
    grid = np.linspace(lowest, highest, 16 * _LEVELS)
    inside = gain * (grid - offset) + 0.375 * gain**2 + read_noise**2
    map_of = 2 / gain * np.sqrt(np.maximum(inside, 0))
    expected = np.interp(pixel_values, grid, map_of).mean((0, 1))
    return Stabiliser(grid, map_of, gain * rates + offset, _increasing(expected))


def estimated_stabiliser(images: Array) -> Stabiliser:
    """The stabiliser for noise whose variance, linear in the signal, is estimated from the images.

    The noise is estimated robustly from second differences along both axes, in groups of equal local mean.

    Args:
        images: (image, y, x), at least 3 x 3 pixels. Raises ValueError if they are smaller.
    """
    if min(images.shape[1:]) <= 2:
        raise ValueError("images of fewer than 3 x 3 pixels cannot be denoised; choose a method without a denoiser")
    slope, intercept = _variance_line(np.asarray(images, dtype=np.float64))
    low, high = float(images.min()), float(images.max())
    middle = intercept + slope * (low + high) / 2
    if slope * (high - low) <= 0.05 * abs(middle):  # hardly signal-dependent: scaling alone stabilises
        deviation = math.sqrt(max(middle, 1e-12 * (high - low) ** 2))
        at = np.array([low, high])
        return Stabiliser(at, at / deviation, at, at / deviation)
    if intercept > 0:
        return anscombe(slope, 0.0, math.sqrt(intercept), images)
    return anscombe(slope, -intercept / slope, 0.0, images)


def _variance_line(images: Array) -> tuple[float, float]:
    mask = np.outer([1, -2, 1], [1, -2, 1]) / 6.0  # unit gain for white noise, zero for planes
    means, squares = [], []
    for image in images:
        windows = np.lib.stride_tricks.sliding_window_view(image, (3, 3))
        squares.append((np.einsum("ijkl,kl->ij", windows, mask) ** 2)[::2, ::2].ravel())
        means.append(windows.mean((2, 3))[::2, ::2].ravel())
    mean, square = np.concatenate(means), np.concatenate(squares)
    order = np.argsort(mean)
    groups = np.array_split(order, max(4, min(40, order.size // 500)))
    level = np.array([mean[group].mean() for group in groups])
    # the median of χ² with one degree of freedom
    variance = np.array([np.median(square[group]) / 0.4549 for group in groups])
    slope, intercept = np.polyfit(level, variance, 1, w=1 / np.maximum(variance, max(1e-3 * variance.max(), 1e-30)))
    return float(slope), float(intercept)


def _increasing(values: Array) -> Array:
    """Make values strictly increasing with the smallest change, so that an inverse exists where clipping makes them flat."""
    step = 1e-9 * max(float(np.ptp(values)), 1e-12)
    return np.asarray(np.maximum.accumulate(values) + step * np.arange(values.size))


def _extended(values: Array, at: Array, table: Array) -> Array:
    """Linear interpolation with linear extrapolation beyond both ends."""
    return np.asarray(scipy.interpolate.make_interp_spline(at, table, k=1)(values))
