from .base import Regulariser as Regulariser
from .total_variation import TotalVariation as TotalVariation
from .total_variation import total_variation as total_variation
