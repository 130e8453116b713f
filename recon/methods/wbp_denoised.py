"""Weighted back-projection of individually denoised images."""

from recon.methods import wbp
from recon.methods._denoised import after_denoising

METHOD = after_denoising("wbp-denoised", "Images denoised one by one, then back-projection.", wbp.METHOD)
