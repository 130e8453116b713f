"""Noise models for other programs: deepinv, and the Gaussian-mixture file of PN2V and CAREamics.

How a composition works: an adapter takes any noise model, and answers with the other program's own interface or file.
"""

from .adapters import PolynomialMixture as PolynomialMixture
from .adapters import to_deepinv as to_deepinv
from .adapters import to_deepinv_fidelity as to_deepinv_fidelity
from .adapters import to_pn2v_gmm as to_pn2v_gmm
