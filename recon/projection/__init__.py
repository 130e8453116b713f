"""Projection of volumes to images: slice operator, tiles, defocus, rays and detector response."""
