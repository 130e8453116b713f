"""Traces of what was done to stored values: lossy compression, and codes that become coarser with brightness.

Transform coefficients are quantised on the compressor's own block grid, and on no other.
JPEG and its successors quantise cosine coefficients of 8 × 8 blocks; JPEG 2000 quantises wavelet coefficients.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pywt
from numpy.lib.stride_tricks import sliding_window_view

from calibration.exposures.frames import Burst, ExposurePair, Image, rounding_step
from calibration.exposures.masks import broken_lines
from calibration.exposures.scaling import one_sigma
from calibration.tolerances import CERTAIN, CLEAR, MOST_LEFT_OUT, PEAK, PIXELS
from noiseflow.statistics import robust_deviation

LARGEST = 256  # side of the region that is tested for compression, pixels


def block_compressed(frame: Image, *, side: int = 8, least: float = 0.1, fewest: int = 4, top: float = 0.9) -> bool:
    """Test whether a (y, x) frame was compressed in blocks, as by JPEG.

    The compressor quantises the coefficients of its own blocks, and sets high frequencies to zero. On every other block grid the
    coefficients have a continuous distribution. If all of them are zero, only the rounding of the pixel values remains on the
    compressor's grid, while the other grids contain the edges of the blocks.

    Args:
        side: side of a block in JPEG and its successors, pixels.
        least: smallest loss of power, nats, in the high-frequency coefficients of the compressed grid. The power of noise in
            these 1000 blocks differs by 0.01 between grids. Strong compression that leaves only rounding removes 1.5;
            compression below the threshold changes the gain by less than 2 %.
        fewest: blocks without which nothing is found.
        top: quantile of the coefficients to which their median is compared.
    """
    part = frame[:LARGEST, :LARGEST]
    number = np.arange(side // 2, side)[:, None]
    basis = np.cos(np.pi * number * (np.arange(side) + 0.5) / side) * np.sqrt(2 / side)
    (shares, power), scatter = np.empty((2, side, side)), []
    rows, columns = ((size - side + 1) // side for size in part.shape)  # as many blocks on every grid
    if rows * columns < fewest:
        return False
    along = sliding_window_view(part, side, axis=1) @ basis.T
    every = np.moveaxis(np.tensordot(basis, sliding_window_view(along, side, axis=0), (1, 3)), 3, 0)  # of all grids
    for dy in range(side):
        for dx in range(side):
            fine = every[..., dy::side, dx::side][..., :rows, :columns].reshape(-1, rows * columns)
            mean = np.maximum(np.mean(squares := fine**2, axis=1), np.finfo(float).tiny)
            half, nine = np.quantile(np.abs(fine), (0.5, top), axis=1)  # a few bright blocks may hold most of the power
            shares[dy, dx] = float(np.mean(half / np.maximum(nine, np.finfo(float).tiny)))
            power[dy, dx] = float(np.mean(np.log(mean)))
            scatter.append((1 / mean @ squares).std() / len(mean) / np.sqrt(rows * columns))
    deviation = max(robust_deviation(power), float(np.median(scatter)))  # of the grids, and by that of the blocks
    lost = float(np.median(power) - power.min()) > max(least, CLEAR * deviation)
    share = np.abs(shares - np.median(shares)).max()
    return bool(lost or share > CERTAIN * robust_deviation(shares))


def wavelet_compressed(frame: Image, *, alone: float = 4.0) -> bool:
    """Test whether a (y, x) frame was compressed with loss by wavelets (JPEG 2000), or every second pixel was interpolated.

    The compressor rounds wavelet coefficients to multiples of a step. On its own grid, one of four, they remain multiples.

    Args:
        alone: factor by which the compressor's grid must exceed another one. Quantised pixel values would show on all four grids
            alike. After strong compression few coefficients are left, and two other grids resemble the compressor's.
    """
    part = frame[:LARGEST, :LARGEST] / (rounding_step(frame) or 1.0)
    # broken lines are no coefficients that a compressor set to zero; two pixels away is the same grid
    part = np.where(broken_lines(part[None]), np.roll(part, (2, 2), (0, 1)), part)
    power = [
        # the wavelets of its lossless and lossy modes, 5/3 and 9/7 (ITU-T T.800, annex F)
        max(
            _lattice(band)
            for kind in ("bior2.2", "bior4.4")
            for band in pywt.dwt2(part[dy:, dx:], kind, "periodization")[1]
        )
        for dy in (0, 1)
        for dx in (0, 1)
    ]
    return max(power) > PEAK and max(power) > alone * min(power)


def _lattice(values: Image) -> float:
    """Largest power of exp(2πi·value/step) over steps between 3 rounding steps and one standard deviation of the values."""
    low, middle, high = one_sigma(values.ravel())
    values, deviation = values.ravel() - middle, float(high - low) / 2
    inner = values[np.abs(values) < 8 * max(deviation, 4.0)]
    index = np.round(2 * inner).astype(int)
    density = np.fft.rfft(np.bincount(index - index.min(), minlength=1 << 12))
    frequency = 2 * np.arange(len(density)) / (2 * len(density) - 2)
    tried = (frequency > 0.8 / max(deviation, 4.0)) & (frequency < 1 / 3)
    return float(np.max(np.abs(density[tried]) ** 2, initial=0.0)) / len(inner)


def deviations(values: Image) -> Image:
    """Distance from the median in robust standard deviations; of values that repeat, the next one is no outlier."""
    away = values - np.median(values)
    return np.asarray(away / np.hypot(robust_deviation(values), np.min(np.abs(away), where=away != 0, initial=np.inf)))


def coarser_above(frame: Image, *, window: int = 32, coarser: float = 0.6) -> float | None:
    """Return the brightness, counts, above which a (y, x) frame uses fewer of its codes; None if it uses them evenly.

    Args:
        window: codes counted together: with a noise of ten codes or more, the density of pixel values is uniform within them.
        coarser: fraction of the codes in use, relative to darker pixels, below which bright codes count as coarser. Most combined
            converters skip every second code; a converter with one missing code in eight uses seven eighths.
    """
    if not rounding_step(frame) or np.ptp(frame) > window * frame.size:  # most codes have no pixel
        return None
    low = frame.min()
    number = np.bincount((frame - low).astype(np.int64).ravel())
    code = np.flatnonzero(number)
    code, count = code + low, number[code]
    whole = code < code[0] + (code[-1] - code[0]) // window * window  # the last window is incomplete
    if whole.sum() < 4 * window:
        return None
    code, count = code[whole], count[whole]
    place = ((code - code[0]) // window).astype(int)
    pixels, used = np.bincount(place, count), np.bincount(place)
    expected = window * -np.expm1(pixels * np.log1p(-1 / window))  # expected number of codes hit by so many pixels
    filled = np.flatnonzero(pixels >= window)
    used, expected, above = used[filled], expected[filled], pixels[::-1].cumsum()[::-1][filled] / frame.size
    if len(filled) < 3:
        return None
    below = np.cumsum(used) / np.cumsum(expected)
    beyond = np.cumsum(used[::-1])[::-1] / np.cumsum(expected[::-1])[::-1]
    ratio = np.where(above[1:] > PIXELS, beyond[1:] / below[:-1], 1.0)
    join = int(np.argmin(ratio))
    return float(code[0] + window * filled[join + 1]) if ratio[join] < coarser else None


def below_joins(
    exposures: Sequence[ExposurePair] | Burst,
) -> tuple[Sequence[ExposurePair] | Burst, tuple[float, float]]:
    """Clip exposures where their codes become coarser, so that the remaining pixel values come from one converter.

    Returns:
        The exposures, clipped if this affects at most `MOST_LEFT_OUT` of the pixels; the lowest brightness of a join, counts, and
        the largest share of pixels above it (infinity and 0 if there is no join).
    """
    frames = [exposures.frames[0]] if isinstance(exposures, Burst) else [pair.short for pair in exposures]
    joins = [np.inf if join is None else join for join in map(coarser_above, frames)]
    share = max(float(np.mean(frame >= join)) for frame, join in zip(frames, joins, strict=True))
    if not 0 < share <= MOST_LEFT_OUT:
        return exposures, (min(joins), share)
    if isinstance(exposures, Burst):
        return replace(exposures, frames=np.minimum(exposures.frames, joins[0])), (min(joins), share)
    clipped = (np.minimum(frame, join) for frame, join in zip(frames, joins, strict=True))
    return [replace(pair, short=short) for pair, short in zip(exposures, clipped, strict=True)], (min(joins), share)
