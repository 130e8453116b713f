"""Conditional noise models for microscopy: fit, sample and evaluate p(observation | signal).

Names are imported on first use, so that importing the package is fast and ``noiseflow -h`` does not load torch.
"""

import lazy_loader as _lazy

_load, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from noiseflow.installation import library_version

        return library_version()
    return _load(name)
