"""Evaluation of noise models on held-out data, and tests for structure in their residuals.

How a composition works: `evaluate` compares likelihood, divergences, their floors and tails of one model; `spatial_structure`
tests whether pixels are independent given their signals. Both take any model, arrays or tensors, and return a frozen dataclass.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
