"""Calibration of a detector's noise from exposures. Imports `noiseflow`, never `recon`."""

import lazy_loader as _lazy

from calibration._moved import MOVED as _MOVED
from noiseflow.moved import keep_old_paths as _keep_old_paths

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

_keep_old_paths("calibration", _MOVED)
