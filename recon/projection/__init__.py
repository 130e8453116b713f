"""From volumes to images: the slice operator, tiles, defocus, rays and the detector response."""
