"""Fitting of noise models: the optimisation loop, its tables, and model selection."""
