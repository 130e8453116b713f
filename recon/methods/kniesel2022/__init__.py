"""The published method of Kniesel et al. (CVPR 2022), with its own settings. It takes days; other methods take seconds."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
