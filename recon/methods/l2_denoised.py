"""Images denoised one by one, then least squares with total variation."""

from recon.methods import l2
from recon.methods._denoised import after_denoising

METHOD = after_denoising(
    "l2-denoised", "Images denoised one by one, then least squares with total variation.", l2.METHOD
)
