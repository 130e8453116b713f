"""Registration of exposures."""
