"""The command-line program `noiseflow`, and the commands that need only this package.

How a composition works: `cli` finds commands by entry point, in this package and in others; a command is a function whose
parameters are its options. It prints through `console.Output`, as lines or as one JSON object, and raises errors that `cli`
prints in one line.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
