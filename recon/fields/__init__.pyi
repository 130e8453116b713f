from .fields import Field as Field
from .fields import MultiresolutionField as MultiresolutionField
from .fields import VoxelField as VoxelField
