"""How far to trust a volume: error bars, and figures of a volume with their intervals."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
