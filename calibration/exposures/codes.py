"""Detection of codes that become coarser with brightness: two converters combined in one frame, or companded values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.exposures.frames import Burst, ExposurePair, Image, rounding_step

WINDOW = 32
"""Codes counted together: with a noise of ten codes or more, the density of pixel values is uniform within a window."""

COARSER = 0.6
"""Fraction of the codes in use, relative to darker pixels, below which bright codes count as coarser. Most combined converters
skip every second code; a converter with one missing code in eight uses seven eighths."""

LEAST_PIXELS = 0.005
"""Smallest share of pixels above a join that is considered; it shifts the photon-transfer line by about as much."""

MOST_JOINED = 0.1
"""Largest share of pixels above a join for which the pixels below are measured alone. Noise scatters the clipped pixels over the
scene, and their neighbours are excluded with them."""


def coarser_above(frame: Image) -> float | None:
    """Return the brightness, counts, above which a frame uses fewer of its codes; None if it uses them evenly.

    Args:
        frame: (y, x) pixel values.
    """
    if not rounding_step(frame):
        return None
    code, count = np.unique(frame, return_counts=True)
    whole = code < code[0] + (code[-1] - code[0]) // WINDOW * WINDOW  # the last window is incomplete
    if whole.sum() < 4 * WINDOW:
        return None
    code, count = code[whole], count[whole]
    window = ((code - code[0]) // WINDOW).astype(int)
    pixels, used = np.bincount(window, count), np.bincount(window)
    expected = WINDOW * -np.expm1(pixels * np.log1p(-1 / WINDOW))  # expected number of codes hit by so many pixels
    filled = np.flatnonzero(pixels >= WINDOW)
    used, expected, above = used[filled], expected[filled], pixels[::-1].cumsum()[::-1][filled] / frame.size
    if len(filled) < 3:
        return None
    below = np.cumsum(used) / np.cumsum(expected)
    beyond = np.cumsum(used[::-1])[::-1] / np.cumsum(expected[::-1])[::-1]
    ratio = np.where(above[1:] > LEAST_PIXELS, beyond[1:] / below[:-1], 1.0)
    join = int(np.argmin(ratio))
    return float(code[0] + WINDOW * filled[join + 1]) if ratio[join] < COARSER else None


def below_joins(
    exposures: Sequence[ExposurePair] | Burst,
) -> tuple[Sequence[ExposurePair] | Burst, tuple[float, float]]:
    """Clip exposures where their codes become coarser, so that the remaining pixel values come from one converter.

    Returns:
        The exposures, clipped if this affects at most `MOST_JOINED` of the pixels; the lowest brightness of a join, counts, and
        the largest share of pixels above it (infinity and 0 if there is no join).
    """
    frames = [exposures.frames[0]] if isinstance(exposures, Burst) else [pair.short for pair in exposures]
    joins = [np.inf if join is None else join for join in map(coarser_above, frames)]
    share = max(float(np.mean(frame >= join)) for frame, join in zip(frames, joins, strict=True))
    if not 0 < share <= MOST_JOINED:
        return exposures, (min(joins), share)
    clipped: Sequence[ExposurePair] | Burst
    if isinstance(exposures, Burst):
        clipped = replace(exposures, frames=np.minimum(exposures.frames, joins[0]))
    else:
        clipped = [
            replace(pair, short=np.minimum(pair.short, join)) for pair, join in zip(exposures, joins, strict=True)
        ]
    return clipped, (min(joins), share)
