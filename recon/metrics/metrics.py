"""Errors of a volume or projection relative to a reference: MSE, PSNR, DSSIM, and Fourier shell correlation."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import skimage
from numpy.typing import NDArray
from torch import Tensor

from noiseflow import io
from noiseflow.arguments import check_shapes
from noiseflow.arrays import Given, alike
from noiseflow.described import described
from noiseflow.io import mapped
from noiseflow.statistics import Array as Array

Scaling = Literal["raw", "affine", "min-max"]
SCALINGS: tuple[Scaling, ...] = get_args(Scaling)


@described(mse="squared ranges", psnr="dB")
@dataclass(frozen=True)
class Errors:
    """Errors of an array relative to a reference, both scaled by the range of the reference.

    Attributes:
        mse: mean squared error, in units of the squared range of the reference.
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
        scaling: ``raw`` uses the values unchanged; ``affine`` first fits gain and offset of `result` by least squares;
            ``min-max`` scales both to [0, 1], as in the tables of Kniesel et al.

    Raises:
        ValueError: shapes differ, pixels are not finite, the reference is constant, or images have fewer than 3 x 3 pixels.

    Example:
        >>> import numpy as np, recon
        >>> truth = np.pad(np.ones((4, 4, 4)), 2)
        >>> round(recon.compare(truth + 0.1, truth).psnr, 1), recon.compare(truth + 0.1, truth, scaling="affine").mse < 1e-12
        (20.0, True)
    """
    found, truth = _checked(result, reference)
    if truth.ndim == 2:
        found, truth = found[None], truth[None]
    line, span = matching_line(found, truth, scaling), float(truth.max()) - float(truth.min())
    squares, similar = 0.0, 0.0
    for one, other in _sections(found, truth):
        matched = line(one)
        squares += float(np.sum((matched - other) ** 2))
        similar += _similarity(matched, other, span)
    mse = squares / truth.size / span**2
    psnr = math.inf if mse == 0 else -10 * math.log10(mse)
    return Errors(mse, psnr, (1 - similar / len(truth)) / 2)


def _line(centre: float, gain: float, level: float) -> Callable[[Array], Array]:
    """The linear map (values − centre)·gain + level."""
    changes_nothing = gain == 1 and centre == level
    return lambda values: values if changes_nothing else np.asarray((values - centre) * gain + level)


def matching_line(result: Array, reference: Array, scaling: Scaling) -> Callable[[Array], Array]:
    """The linear map from a result to the scale of its reference; volumes are processed section by section."""
    if scaling == "raw":
        return _line(0.0, 1.0, 0.0)
    if scaling == "min-max":
        (low, high), (least, most) = ((float(a.min()), float(a.max())) for a in (result, reference))
        return _line(low, (most - least) / (high - low) if high > low else 0.0, least)
    if scaling != "affine":
        raise ValueError(f"scaling '{scaling}': choose raw, affine or min-max")
    means = [sum(float(part.sum(dtype=np.float64)) for part in a) / a.size for a in (result, reference)]
    power = product = 0.0
    for one, other in _sections(result, reference):
        centred = one - means[0]
        power += float(np.sum(centred**2))
        product += float(np.sum(centred * (other - means[1])))
    return _line(means[0], product / power if power > 0 else 0.0, means[1])


def _sections(*arrays: Array) -> Iterator[tuple[Array, ...]]:
    """Sections of arrays that may be larger than memory, as float64."""
    for parts in zip(*arrays, strict=True):
        yield tuple(np.asarray(part, dtype=np.float64) for part in parts)


def fourier_shell_correlation(first: Given, second: Given) -> tuple[Given, Given]:
    """Correlation of two volumes or images by shells of spatial frequency (doi:10.1016/0304-3991(86)90198-4).

    Args:
        first, second: arrays or tensors of the same shape.

    Returns:
        Frequencies in cycles per voxel up to 0.5, and the correlation at each, of the same array type as the input.

    Raises:
        ValueError: shapes differ, or pixels are not finite.

    Example:
        >>> import numpy as np, recon
        >>> volume = np.random.default_rng(0).random((16, 16, 16))
        >>> frequency, correlation = recon.fourier_shell_correlation(volume, volume)
        >>> frequency[-1].item(), bool(np.allclose(correlation, 1))
        (0.5, True)
    """
    one, other = _checked(first, second, flat=True)
    shells = min(one.shape) // 2
    cross, power_f, power_g = _shell_sums(one, other, shells)
    norm = np.sqrt(power_f * power_g)
    correlation = np.divide(cross, norm, out=np.zeros_like(cross), where=norm > 0)
    return alike(np.arange(shells + 1) / (2 * shells), first), alike(correlation, first)


def _shell_sums(first: Array, second: Array, shells: int) -> Array:
    """(3, shells + 1) shell sums of the product of two spectra and of their powers, computed slab by slab; large spectra are
    in temporary files."""
    if first.ndim == 2:
        first, second = first[None], second[None]
    depth, height, _ = first.shape
    spectra = [_section_spectra(array) for array in (first, second)]
    sums, rows = np.zeros((3, shells + 1)), max(1, mapped.PART // (16 * depth * spectra[0].shape[2]))
    for start in range(0, height, rows):
        part = slice(start, start + rows)
        f, g = (np.fft.fft(spectrum[:, part], axis=0) for spectrum in spectra)
        shell, times = shells_of(first.shape, shells, part)
        for total, values in zip(sums, ((f * g.conj()).real, np.abs(f) ** 2, np.abs(g) ** 2), strict=True):
            total += np.bincount(shell.ravel(), weights=(values * times).ravel(), minlength=shells + 1)[: shells + 1]
    return sums


def shells_of(shape: tuple[int, ...], shells: int, rows: slice = slice(None)) -> tuple[NDArray[np.intp], Array]:
    """The shell of each frequency (kz, ky, kx) in the half spectrum of a real volume, and its multiplicity, (kx,).

    Args:
        shape: (z, y, x).
        shells: number of shells up to 0.5 cycles per voxel; frequencies in the corners have higher indices.
        rows: range along ky.
    """
    z, y, x = np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1])[rows], np.fft.rfftfreq(shape[2])
    squared = (z**2)[:, None, None] + (y**2)[:, None] + x**2
    times = np.full(len(x), 2.0)
    times[0] = 1.0
    if shape[2] % 2 == 0:
        times[-1] = 1.0
    return np.rint(np.sqrt(squared) * 2 * shells).astype(np.intp), times


def _section_spectra(volume: Array) -> Array:
    """(z, ky, kx) Fourier transform of every section of a volume, non-negative half along x."""
    shape = (*volume.shape[:2], volume.shape[2] // 2 + 1)
    # for larger volumes, disk space matters more than the eighth digit
    exact = 16 * math.prod(shape) <= mapped.IN_MEMORY
    found = mapped.temporary_map(shape, np.complex128 if exact else np.complex64)
    for target, section in zip(found, volume, strict=True):
        target[...] = np.fft.rfft2(np.asarray(section, dtype=np.float64))
    return found


def compare_images(result: Array | Tensor, reference: Array | Tensor, *, scaling: Scaling = "raw") -> Errors:
    """Compare images with their references one by one, and return the mean errors. Raises ValueError as `compare`.

    Args:
        result: (image, y, x).
        scaling: as in `compare`, applied to every image separately.
    """
    errors = [compare(one, other, scaling=scaling) for one, other in zip(*_alike(result, reference), strict=True)]
    return Errors(*(float(np.mean([getattr(e, name) for e in errors])) for name in ("mse", "psnr", "dssim")))


def resolution(frequency: Array, correlation: Array, threshold: float) -> float:
    """The frequency at which a shell correlation first falls below a threshold, by linear interpolation.

    Args:
        frequency: (N,) cycles per voxel, increasing.
        correlation: (N,) from `fourier_shell_correlation`; the first shell, the mean, is ignored.
        threshold: 0.143 for two independent halves (doi:10.1016/j.jmb.2003.07.013), 0.5 against the truth.

    Returns:
        Cycles per voxel; 0.5 if it never falls below the threshold, 0 if it starts below it.
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
    """A description of a result of `resolution`, also as a length if the voxel size (Å) is known."""
    return f"stays above {threshold:g} up to {frequencies_in_words((crossing,), voxel_size)}"


def frequencies_in_words(frequencies: Sequence[float], voxel_size: float | None) -> str:
    """One frequency (cycles per voxel) or a range, also as lengths if the voxel size (Å) is known."""
    ends = sorted({f"{each:.3f}": each for each in frequencies}.items())
    words = f"{' to '.join(text for text, _ in ends)} cycles per voxel"
    if not voxel_size or not ends[0][1]:
        return words
    periods = [voxel_size / each for _, each in ends]
    size, unit = (10, "nm") if periods[-1] >= 10 else (1, "Å")
    return f"{words} ({' to '.join(f'{period / size:.3g}' for period in periods)} {unit})"


def _similarity(result: Array, reference: Array, span: float) -> float:
    window = min(7, (min(reference.shape) - 1) // 2 * 2 + 1)
    if window < 3:
        raise ValueError(f"images of shape {reference.shape} are too small; give at least 3 x 3 pixels")
    return float(skimage.metrics.structural_similarity(result, reference, data_range=span, win_size=window))  # type: ignore[no-untyped-call]


def _checked(result: Array | Tensor, reference: Array | Tensor, *, flat: bool = False) -> tuple[Array, Array]:
    result, reference = _alike(result, reference)
    io.require_finite(result, "the result")
    io.require_finite(reference, "the reference")
    if not flat:
        io.require_contrast(reference, "the reference")
    return result, reference


def _alike(result: Array | Tensor, reference: Array | Tensor) -> tuple[Array, Array]:
    first, second = io.as_array(result), io.as_array(reference)
    check_shapes(result=first, reference=second)
    return first, second
