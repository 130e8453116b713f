"""The optimisation loop, its tables, and the choice among noise models."""
