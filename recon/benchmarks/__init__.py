"""Benchmarks of the reconstruction; `noiseflow benchmark` runs them."""
