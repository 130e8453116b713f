from .joint import JointReconstructor as JointReconstructor
from .joint import Reconstruction as Reconstruction
