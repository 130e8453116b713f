"""Uncertainty of a volume: error bars, and measurements with intervals.

How a composition works: `Energy` is the negative log-posterior of a fitted volume; `Posterior` samples it in steps, keeping sums
over the samples alone; its `Uncertainty` has standard deviation, bias and the band of the shell correlation, from which `measure`
derives intervals.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
