"""Denoisers of single images as functions from image to image, for methods that denoise before reconstruction."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from noiseflow.installation import install_command
from recon.denoise import stabilise

Array = NDArray[Any]
Denoiser = Callable[[Array], Array]
_STRENGTHS = (0.5, 0.7, 1.0, 1.4, 2.0)
_CALIBRATION_SIZE = 128


def non_local_means(image: Array, strength: float) -> Array:
    """Non-local means (doi:10.1109/CVPR.2005.38) of an image (y, x) with unit noise; `strength` scales the filter."""
    from skimage.restoration import denoise_nl_means

    options = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "sigma": 1.0}
    return np.asarray(denoise_nl_means(image, h=0.8 * strength, **options))


def total_variation(image: Array, strength: float) -> Array:
    """Chambolle's total variation (doi:10.1023/B:JMIV.0000011325.36760.1e) of an image with unit noise."""
    from skimage.restoration import denoise_tv_chambolle

    return np.asarray(denoise_tv_chambolle(image, weight=strength))  # type: ignore[no-untyped-call]


def wavelet(image: Array, strength: float) -> Array:
    """BayesShrink wavelet soft thresholding (doi:10.1109/83.862633), averaged over shifts, for noise of `strength`."""
    from skimage.restoration import cycle_spin, denoise_wavelet

    options = {"sigma": strength, "method": "BayesShrink", "mode": "soft", "wavelet": "db2"}
    spun = cycle_spin(image, func=denoise_wavelet, max_shifts=3, func_kw=options, workers=1)
    return np.asarray(spun)


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
        raise ValueError(
            f"denoiser bm3d needs its package: {install_command('bm3d')} (its licence allows non-commercial use only)"
        ) from None
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
    stabiliser = stabilise.estimated(images) if noise_model is None else stabilise.of_noise_model(noise_model, images)
    function = DENOISERS[name]
    middle = stabiliser.forward(np.asarray(images[len(images) // 2], dtype=np.float64))
    strength = 1.0 if name == "bm3d" else best_strength(function, middle)

    def denoise(image: Array) -> Array:
        stabilised = stabiliser.forward(np.asarray(image, dtype=np.float64))
        return stabiliser.inverse(function(stabilised, strength)).astype(np.float32)

    return denoise


def best_strength(function: Callable[[Array, float], Array], image: Array) -> float:
    """The strength whose J-invariant result, which predicts each pixel from the others, is closest to the noisy image."""
    from skimage.restoration import denoise_invariant

    rows, columns = (slice(max(0, (n - _CALIBRATION_SIZE) // 2), (n + _CALIBRATION_SIZE) // 2) for n in image.shape)
    crop = image[rows, columns]
    errors = {}
    for strength in _STRENGTHS:
        predicted = denoise_invariant(crop, lambda part, strength=strength: function(part, strength))  # type: ignore[no-untyped-call]
        errors[strength] = float(np.mean((predicted - crop) ** 2))
    finite = {strength: error for strength, error in errors.items() if math.isfinite(error)}
    return min(finite, key=lambda strength: finite[strength], default=1.0)


def _of_user(name: str) -> Denoiser:
    module_name, _, function_name = name.partition(":")
    try:
        function = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"denoiser {name}: cannot be imported ({error}); give package.module:function") from error

    def denoise(image: Array) -> Array:
        try:
            result = np.asarray(function(image), dtype=np.float64)
        except Exception as error:  # user code may raise anything
            problem = f"it failed on an image of shape {image.shape} with {type(error).__name__} ({error})"
            raise ValueError(f"denoiser {name}: {problem}; it must take an image and return one") from error
        if result.shape != image.shape or not np.isfinite(result).all():
            raise ValueError(
                f"denoiser {name}: it must return a finite image of shape {image.shape}; it returned shape {result.shape}"
            )
        return result.astype(np.float32)

    return denoise
