"""Conditional noise models for microscopy: p(observation | signal), fitted, sampled and judged.

Names load on first use, so importing the package costs nothing and ``noiseflow -h`` answers without torch.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
