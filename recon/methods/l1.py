"""Least absolute deviations with the field and the regulariser of the joint fit."""

from recon.joint.laplace import Laplace
from recon.methods._fitted import fitted

METHOD = fitted(
    "l1",
    "Least absolute deviations, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Laplace},
)
