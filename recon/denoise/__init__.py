"""Denoisers of single images, and variance stabilisation."""
