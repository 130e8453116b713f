"""Base classes of all noise distributions."""

from noiseflow.distributions import divergence as divergence  # registers kl_divergence
from noiseflow.distributions.latent import LatentDistribution as LatentDistribution
from noiseflow.distributions.law import NoiseDistribution as NoiseDistribution
from noiseflow.distributions.law import RescaledDistribution as RescaledDistribution
from noiseflow.distributions.law import bisect_quantile as bisect_quantile
from noiseflow.distributions.normal import log_normal_cdf as log_normal_cdf
from noiseflow.distributions.normal import log_normal_interval as log_normal_interval
from noiseflow.distributions.normal import normal_hazard as normal_hazard
from noiseflow.distributions.normal import normal_quadrature as normal_quadrature
