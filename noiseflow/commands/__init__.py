"""The command-line program `noiseflow`, and the commands that need only this package."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
