"""Conditional noise models for microscopy: fit, sample and evaluate p(observation | signal).

Names are imported on first use, so that importing the package is fast and ``noiseflow -h`` does not load torch.
"""

import lazy_loader as _lazy

from noiseflow._moved import MOVED as _MOVED
from noiseflow.moved import keep_old_paths as _keep_old_paths

_load, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from noiseflow.installation import library_version

        return library_version()
    if name in _MOVED and name not in __all__:
        from importlib import import_module

        return import_module(f"noiseflow.{name}")
    return _load(name)


_keep_old_paths("noiseflow", _MOVED)
