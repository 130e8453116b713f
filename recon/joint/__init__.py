"""The joint fit of volume, detector response and noise model.

How a composition works: `plan` turns facts and settings into a list of stages; `run.Runner` carries the list out on tasks, the
slab and the whole volume; `JointReconstructor` makes facts, models and tasks from a tilt series. A `Journal` passed as
``run_fit`` and ``run_stage`` stores each stage by name, so that an interrupted run resumes.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
