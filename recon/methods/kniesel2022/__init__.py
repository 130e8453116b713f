"""The published method of Kniesel et al. (CVPR 2022), with its own settings."""
