from .base import LatentDistribution as LatentDistribution
from .base import NoiseDistribution as NoiseDistribution
from .base import RescaledDistribution as RescaledDistribution
from .base import bisect_quantile as bisect_quantile
from .base import log_normal_cdf as log_normal_cdf
from .base import log_normal_interval as log_normal_interval
from .base import normal_hazard as normal_hazard
from .base import normal_quadrature as normal_quadrature
