"""Functions that the distributions are computed with: tails, quadrature, maps, tables."""
