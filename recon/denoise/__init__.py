"""Denoisers of single images, and the variance stabilisation they work in."""
