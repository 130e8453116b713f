"""Noise distributions that noise models return.

How a composition works: a law (`laws`) has ``log_prob``, ``cdf``, ``icdf``, ``sample`` and a quadrature of its own; a wrapper
(`wrappers`) holds a law and answers from its intervals. `conventions` wraps these methods once for all classes: data types,
NaN, shapes, pieces of large inputs, and tables where no gradient is needed. `numerics` and `electrons` hold the functions that
laws are computed with, and know no law.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
