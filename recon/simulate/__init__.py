"""Simulation: phantoms, known noise, and tilt series of them.

How a composition works: a phantom draws any slices of a density; an `Acquisition` turns its projections into signals and names
the true noise; a `Simulation` writes both to files, block by block.
"""
