from .joint import JointReconstructor as JointReconstructor
from .run import Settled as Settled
