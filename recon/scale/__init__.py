"""Volumes larger than memory, and many series.

How a composition works: a method with a `Blockwise` form settles everything that the volume shares once; `blocks` divides the
slices; each block is solved, alone or on a Dask worker, and stored in a file; overlaps are blended when all are there.
"""
