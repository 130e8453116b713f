"""Gain, offset and read noise from aligned exposures, and selection of a noise model.

How a composition works: pixels are grouped by signal (`levels`, `cells`), whose histograms a likelihood describes
(`likelihood`, `log_posterior`); its posterior gives the figures with their intervals (`posterior`, `figures`), or variance by
signal does where no posterior applies (`photon_transfer`, `emva`). `models` fits noise models to the same pixels.
"""
