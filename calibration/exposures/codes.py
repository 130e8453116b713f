"""Codes of the converter that grow coarser with brightness: two converters joined into one frame, or companded values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.exposures.frames import Burst, ExposurePair, Image, rounding_step

WINDOW = 32
"""Codes that are counted together: the density of pixel values is even within, beside a noise of ten codes or more."""

COARSER = 0.6
"""Share of the codes in use, relative to that of darker pixels, below which bright codes are coarser: every second code is left
out at most joins, seven of eight are used by a converter that misses one code in eight."""

LEAST_PIXELS = 0.005
"""Share of the pixels above a join from which on their variance moves the photon-transfer line by as much."""

MOST_JOINED = 0.1
"""Share of the pixels above a join up to which those below can be measured alone: noise scatters the clipped ones over the scene,
and their neighbours are lost with them."""


def coarser_above(frame: Image) -> float | None:
    """The brightness above which a frame uses fewer of its codes than below; None where it uses them alike.

    Args:
        frame: (y, x) pixel values.
    """
    if not rounding_step(frame):
        return None
    code, count = np.unique(frame, return_counts=True)
    whole = code < code[0] + (code[-1] - code[0]) // WINDOW * WINDOW  # the last window is cut short
    if whole.sum() < 4 * WINDOW:
        return None
    code, count = code[whole], count[whole]
    window = ((code - code[0]) // WINDOW).astype(int)
    pixels, used = np.bincount(window, count), np.bincount(window)
    expected = WINDOW * -np.expm1(pixels * np.log1p(-1 / WINDOW))  # codes that as many pixels hit by chance
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
    """Exposures clipped where their codes grow coarser, so that one converter made all that is left; if these are few.

    Returns:
        The exposures, clipped where at most `MOST_JOINED` of the pixels are; the lowest brightness of a join, counts, and the
        largest share of pixels beyond: infinity and 0 where there is none.
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
