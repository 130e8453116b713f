"""Simulation: phantoms, known noise, and tilt series of them."""
