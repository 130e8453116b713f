"""Single electrons that show in the pixel values: peaks one gain apart, which tell gain and offset far better than variance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.detector.levels import Levels

CLEAR_PEAKS = 25.0
"""Power of the peaks, N·|mean of exp(2πi·value/gain)|², from which on they are there: N random values exceed it with probability
exp(−25), and a search over gains tries a few hundred."""


def electrons_show(levels: Sequence[Levels], gain: float) -> bool:
    """Whether histograms of pixel values have peaks one `gain` apart, as detectors with a read noise below about 0.4 e⁻ give.

    Args:
        levels: those of residuals are ignored: the noise of their signals blurs the peaks.
        gain: counts per electron. Below two rounding steps the peaks cannot be distinguished from the codes.
    """
    total, count = 0j, 0.0
    for one in levels:
        fine = (one.width < gain / 2) & (one.step < gain / 2) & (one.dark == 0)
        if not one.absolute or not fine.any():
            continue
        place = one.origin[fine, None] + one.width[fine, None] * (np.arange(one.histogram.shape[1]) + 0.5)
        total += complex(np.sum(one.histogram[fine] * np.exp(2j * np.pi * place / gain)))
        count += float(one.histogram[fine].sum())
    return count > 0 and abs(total) ** 2 / count > CLEAR_PEAKS
