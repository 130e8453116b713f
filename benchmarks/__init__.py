"""Benchmarks, in a checkout: `noiseflow benchmark` or `python -m benchmarks`; `pages` measures and writes their pages."""
