"""Volume parameterisations (fields), occupancy, and regularisers.

How a composition works: a field is a module whose call returns the (z, y, x) attenuation; a regulariser takes that volume and
returns its penalty. Occupancy restricts both to voxels that can hold matter.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
