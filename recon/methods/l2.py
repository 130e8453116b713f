"""Least squares with the field and the regulariser of the joint fit."""

from noiseflow import Gaussian
from recon.methods._fitted import fitted

METHOD = fitted(
    "l2",
    "Least squares, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Gaussian},
)
