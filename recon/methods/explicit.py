"""Least squares on plain voxels without total variation, with early stopping."""

from noiseflow import Gaussian
from recon.fields.kinds.voxels import VoxelField
from recon.methods._fitted import fitted

METHOD = fitted(
    "explicit",
    "Least squares on plain voxels without total variation, stopped where held-out pixels are predicted best.",
    lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "weight": 0.0},
    refuses=("weight", "regulariser", "field"),
)
