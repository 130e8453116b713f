"""Gain, offset and read noise from aligned exposures, and selection of a noise model."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
