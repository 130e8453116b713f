"""Least squares, as in l2, of individually denoised images."""

from recon.methods import l2
from recon.methods._denoised import after_denoising

METHOD = after_denoising("l2-denoised", "Images denoised one by one, then least squares as of l2.", l2.METHOD)
