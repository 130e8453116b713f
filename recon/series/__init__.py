"""Tilt series: reading, alignment, screening and checks."""
