"""The tolerances of a calibration, one of each unit, and the significance above which an effect counts.

The target accuracy of a gain is 2 %. Tolerances of other quantities change the gain by at most as much.
"""

from noiseflow.statistics import STANDARD_ERRORS

GAIN = 0.02
"""Bias of the gain, or of a variance that it follows: the target accuracy."""

SCENE = 0.003
"""Share of a variance that may follow the scene or the light. A misfit is concentrated where the scene is bright or steep, so the
gain changes by a few times the share; lamps and converters are typically as stable."""

PIXELS = 0.005
"""Share of the pixels, which may have been excluded or treated as clipped: more would shift the photon-transfer line."""

LEVEL = 0.005
"""Relative error of a model of the variance at one level of the signal; no level with very many pixels dominates a line."""

CLIPPED = 1e-3
"""Share of clipped pixel values that hardly affects the variance: clipping at three standard deviations reduces it by 0.3 %."""

UNEVEN = 0.05
"""Relative deviation of the variances of single pixels, or of the widths of codes, that one gain and read noise describe. The
mixture then has tails heavier by its square, 0.25 %, which biases the offset but hardly the gain."""

MODELLED = 0.03
"""Relative error of what a model of interpolation, or of the finest detail, predicts: sub-pixel positions change the correlation
by 0.015, and gains of frames resampled by 0.75 to 1.25 are off by −3 to +6 %."""

MISALIGNED = 0.1
"""Displacement, pixels, without visible residuals; interpolation would do more harm than good."""

MOST_LEFT_OUT = 0.07
"""Largest share of pixels that may be left out, above a join of converters or in regions that changed, while the others are
measured alone. Noise scatters clipped pixels over the scene, and their neighbours are excluded with them; with more changed, the
others may have changed unseen."""

EXCESS = 1.2
"""Smallest excess-noise factor F² of a detector that multiplies electrons: direct detectors and EMCCDs have 1.4 to 2."""

LARGEST_RATIO_ERROR = 0.25
"""Largest difference in the logarithm between the fitted and the given exposure ratio that a change of dose can explain."""

MISFIT = 0.3
"""Excess of χ² per degree of freedom of the histograms of a Poisson-Gaussian detector."""

ANY = 0.0
"""Of facts: whichever their size, they matter."""

LIKELY = STANDARD_ERRORS
"""Standard errors from which an effect that is expected, such as a bent response, is modelled or reported."""

CLEAR = 5.0
"""Standard errors above which a deviation is significant; noise exceeds them at one of 40 lags once in 10⁵ frames."""

STANDS_OUT = 6.0
"""Standard deviations from which a value is no noise: of 10⁸ normal values, none gets there by chance."""

CERTAIN = 8.0
"""Standard deviations from which the best of many candidates is no chance, and which noise with heavy tails does not reach: the
best of all shifts, rotations and motions between unrelated frames reaches 5.5."""

PEAK = CLEAR * CLEAR
"""Significant power of a spectral line, relative to its mean: noise exceeds it with probability exp(−25). A mean known to 30 %
increases this to exp(−17): once in 10⁴ frames with 1000 lines."""
