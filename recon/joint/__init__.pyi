from .joint import JointReconstructor as JointReconstructor
from .joint import Settled as Settled
