"""Reconstruction methods: every file without an underscore is one method.

How a composition works: a method is a value, `METHOD`, made by `classical`, `fitted` or `after_denoising`, or a `Method` of its
own. `reconstruct` checks the settings against it, orients the series as it expects, runs it at once or in blocks, and turns the
result back.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
