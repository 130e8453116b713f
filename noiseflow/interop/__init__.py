"""Noise models for other programs: deepinv, and the Gaussian-mixture file of PN2V and CAREamics."""

from .adapters import PolynomialMixture as PolynomialMixture
from .adapters import to_deepinv as to_deepinv
from .adapters import to_pn2v_gmm as to_pn2v_gmm
