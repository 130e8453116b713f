"""How far a volume or projection is from its reference: MSE, PSNR, DSSIM, and Fourier shell correlation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.arrays import Given, alike
from noiseflow.described import described

Scaling = Literal["raw", "affine", "min-max"]
SCALINGS: tuple[Scaling, ...] = get_args(Scaling)
Array = NDArray[Any]


@described(mse="squared ranges", psnr="dB")
@dataclass(frozen=True)
class Errors:
    """Errors of one array against its reference, both scaled by the reference's range.

    Attributes:
        mse: mean squared error, in squared ranges of the reference.
        psnr: peak signal-to-noise ratio, dB.
        dssim: (1 − SSIM) / 2, the mean over slices along the first axis.
    """

    mse: float
    psnr: float
    dssim: float


def compare(result: Array | Tensor, reference: Array | Tensor, *, scaling: Scaling = "raw") -> Errors:
    """Compare an array with its reference.

    Args:
        result: (z, y, x) or (y, x), an array or a tensor.
        reference: the truth, same shape.
        scaling: ``raw`` takes the numbers as they are; ``affine`` first fits gain and offset of `result` by least
            squares; ``min-max`` brings both to [0, 1], as the tables of Kniesel et al. do.

    Raises:
        ValueError: shapes differ, pixels are not finite, the reference is flat, or images have fewer than 3 x 3 pixels.
    """
    found, truth = _checked(result, reference)
    matched = match(found, truth, scaling=scaling)
    span = float(truth.max() - truth.min())
    mse = float(np.mean((matched - truth) ** 2)) / span**2
    psnr = math.inf if mse == 0 else -10 * math.log10(mse)
    return Errors(mse, psnr, _dssim(matched, truth, span))


def match(result: Array, reference: Array, *, scaling: Scaling) -> Array:
    """`result` brought to the scale of `reference`, as `compare` does it."""
    if scaling == "raw":
        return result
    if scaling == "min-max":
        low, high = float(result.min()), float(result.max())
        gain = (float(reference.max()) - float(reference.min())) / (high - low) if high > low else 0.0
        return (result - low) * gain + float(reference.min())
    if scaling == "affine":
        centred = result - result.mean()
        power = float(np.mean(centred**2))
        gain = float(np.mean(centred * (reference - reference.mean()))) / power if power > 0 else 0.0
        return np.asarray(centred * gain + reference.mean())
    raise ValueError(f"scaling '{scaling}': choose raw, affine or min-max")


def fourier_shell_correlation(first: Given, second: Given) -> tuple[Given, Given]:
    """Correlation of two volumes or images by shells of spatial frequency (doi:10.1016/0304-3991(86)90198-4).

    Args:
        first, second: arrays or tensors of the same shape.

    Returns:
        Frequencies in cycles per voxel up to 0.5, and the correlation at each; of the kind given.

    Raises:
        ValueError: shapes differ, or pixels are not finite.
    """
    one, other = _checked(first, second, flat=True)
    f, g = np.fft.fftn(one), np.fft.fftn(other)
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*(np.fft.fftfreq(n) for n in one.shape), indexing="ij")))
    shells = min(one.shape) // 2
    shell = np.rint(frequency * 2 * shells).astype(int).ravel()
    cross, power_f, power_g = (
        np.bincount(shell, weights=values.ravel(), minlength=shells + 1)[: shells + 1]
        for values in ((f * g.conj()).real, np.abs(f) ** 2, np.abs(g) ** 2)
    )
    norm = np.sqrt(power_f * power_g)
    correlation = np.divide(cross, norm, out=np.zeros_like(cross), where=norm > 0)
    return alike(np.arange(shells + 1) / (2 * shells), first), alike(correlation, first)


def compare_images(result: Array | Tensor, reference: Array | Tensor, *, scaling: Scaling = "raw") -> Errors:
    """Compare images with their references one by one; the mean of each error.

    Args:
        result: (image, y, x).
        reference: the truth, same shape.
        scaling: as `compare`, for every image by itself.

    Raises:
        ValueError: as `compare`.
    """
    from noiseflow.io import as_array

    result, reference = as_array(result), as_array(reference)
    if result.shape != reference.shape:
        raise ValueError(f"the arrays have shapes {result.shape} and {reference.shape}; they must be equal")
    errors = [compare(one, other, scaling=scaling) for one, other in zip(result, reference, strict=True)]
    return Errors(*(float(np.mean([getattr(e, name) for e in errors])) for name in ("mse", "psnr", "dssim")))


def resolution(frequency: Array, correlation: Array, threshold: float) -> float:
    """The frequency at which a shell correlation first falls below a threshold, by linear interpolation.

    Args:
        frequency: (N,) cycles per voxel, increasing.
        correlation: (N,) as `fourier_shell_correlation` gives them; the first shell, the mean, does not count.
        threshold: 0.143 for two independent halves, 0.5 against a truth or between halves of old (doi:10.1016/j.jmb.2003.07.013).

    Returns:
        Cycles per voxel; 0.5 where it never falls so low, 0 where it starts there.
    """
    below = np.flatnonzero(correlation[1:] < threshold) + 1
    if not below.size:
        return 0.5
    last = int(below[0])
    if last == 1:
        return 0.0
    share = (correlation[last - 1] - threshold) / (correlation[last - 1] - correlation[last])
    return float(frequency[last - 1] + share * (frequency[last] - frequency[last - 1]))


def reach_in_words(crossing: float, threshold: float, voxel_size: float | None) -> str:
    """What `resolution` found, and as a length where the voxels (Å) are known."""
    words = f"stays above {threshold:g} up to {crossing:.3f} cycles per voxel"
    if not voxel_size or not crossing:
        return words
    period = voxel_size / crossing
    return words + (f" ({period / 10:.3g} nm)" if period >= 10 else f" ({period:.3g} Å)")


def _dssim(result: Array, reference: Array, span: float) -> float:
    from skimage.metrics import structural_similarity

    if reference.ndim == 2:
        result, reference = result[None], reference[None]
    window = min(7, (min(reference.shape[1:]) - 1) // 2 * 2 + 1)
    if window < 3:
        raise ValueError(
            f"the images have {reference.shape[1]} x {reference.shape[2]} pixels; at least 3 x 3 pixels are needed"
        )
    values = [
        structural_similarity(a, b, data_range=span, win_size=window)  # type: ignore[no-untyped-call]
        for a, b in zip(result, reference, strict=True)
    ]
    return (1 - float(np.mean(values))) / 2


def _checked(result: Array | Tensor, reference: Array | Tensor, *, flat: bool = False) -> tuple[Array, Array]:
    from noiseflow.io import as_array, require_contrast, require_finite

    result, reference = as_array(result), as_array(reference)
    if result.shape != reference.shape:
        raise ValueError(f"the arrays have shapes {result.shape} and {reference.shape}; they must be equal")
    require_finite(result, "the result")
    require_finite(reference, "the reference")
    if not flat:
        require_contrast(reference, "the reference")
    return result.astype(np.float64), reference.astype(np.float64)
