"""How well a noise model fits data it has not seen, and whether its residuals have structure."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
