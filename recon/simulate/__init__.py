"""Volumes of known truth, known noise, and tilt series made of them."""
