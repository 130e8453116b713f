"""Fitting of noise models, and selection among them.

How a composition works: `fit` splits pixels into training and held-out ones (`pixel_split`), and runs the one optimisation loop
(`loop`) over a noise model and any signal model; the loop takes steps, keeps the best held-out state (`steps`), and
looks likelihoods up in a table (`observation_table`) where that is accurate. `select` fits candidates with the same loop
(`contest`) and returns the simplest sufficient one.
"""
