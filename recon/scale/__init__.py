"""Volumes larger than memory, clusters, and batches of series."""
