from .base import Regulariser as Regulariser
from .base import find_regulariser as find_regulariser
from .base import regulariser_names as regulariser_names
from .directional import DirectionalVariation as DirectionalVariation
from .second_order import SecondOrderVariation as SecondOrderVariation
from .second_order import TotalVariation as TotalVariation
from .second_order import total_variation as total_variation
