from .presets import METHOD as METHOD
