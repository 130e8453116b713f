"""Reconstruction of volumes from noisy single-axis tilt series: projector, fields, joint fit, classical methods, metrics.

Names are imported on first use, so that importing the package is fast.
"""

import lazy_loader as _lazy

from noiseflow.moved import keep_old_paths as _keep_old_paths
from recon._moved import MOVED as _MOVED

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

_keep_old_paths("recon", _MOVED)
