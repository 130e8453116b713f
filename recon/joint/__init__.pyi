from .joint import JointReconstructor as JointReconstructor
from .settled import Settled as Settled
