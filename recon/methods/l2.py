"""Least squares: with the field and the regulariser of the joint fit, on plain voxels, or of denoised images."""

from noiseflow import Gaussian
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers import TotalVariation
from recon.methods._fitted import fitted
from recon.methods._registry import after_denoising

METHOD = fitted(
    "l2",
    "Least squares, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Gaussian},
)
METHODS = {
    "explicit": fitted(
        "explicit",
        "Least squares on plain voxels without total variation, stopped where held-out pixels are predicted best.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "weight": 0.0, "held_out": 0.1},
        refuses=("weight", "regulariser", "field"),
    ),
    "tv": fitted(
        "tv",
        "Least squares with total variation on plain voxels.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "regulariser": TotalVariation()},
        refuses=("regulariser", "field"),
    ),
    "l2-denoised": after_denoising("l2-denoised", "Images denoised one by one, then least squares as of l2.", METHOD),
}
