"""Calibration of a detector's noise from exposures. Imports `noiseflow`, never `recon`.

How a composition works: `exposures` reads frames and joins them to pairs, bursts, flats and darks; `registration` aligns them to
pairs of short exposure and signal; `detector` measures the pairs and fits noise models to them; `verdict` judges what was found,
and `report` shows it. `pipeline` is all of it in one call.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
