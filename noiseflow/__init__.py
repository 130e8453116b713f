"""Conditional noise models for microscopy: p(observation | signal), fitted, sampled and judged.

Names load on first use, so importing the package costs nothing and ``noiseflow -h`` answers without torch.
"""

import lazy_loader as _lazy

_load, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("noiseflow")
    return _load(name)
