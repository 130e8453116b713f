"""Least squares with total variation on plain voxels."""

from noiseflow import Gaussian
from recon.fields.kinds.voxels import VoxelField
from recon.fields.regularisers.total_variation import TotalVariation
from recon.methods._fitted import fitted

METHOD = fitted(
    "tv",
    "Least squares with total variation on plain voxels.",
    lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "regulariser": TotalVariation()},
    refuses=("regulariser", "field"),
)
