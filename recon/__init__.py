"""Reconstruction of volumes from noisy single-axis tilt series: projector, fields, joint fit, classical methods, metrics.

Names are imported on first use, so that importing the package is fast.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
