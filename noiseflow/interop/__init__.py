"""Noise models for other programs."""
