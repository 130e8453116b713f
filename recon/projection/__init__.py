"""Projection of volumes, and the detector's response to projections.

How a composition works: a projector is linear, ``A(volume)`` and ``A.T(projections)``; a response (`image_formation`) turns
line integrals into pixel values; tiles of the projector (`tiles`) predict the pixels of a batch. `TomographySignal` of
`recon.joint` composes a field, a projector and a response into a signal model for `noiseflow.fit`.
"""
