"""Former module names of this package: old name → new name. Kept for one version."""

MOVED = {
    "align": "registration.align",
    "aligned": "registration.aligned",
    "bursts": "registration.bursts",
    "cells": "detector.cells",
    "figures": "report.figures",
    "levels": "detector.levels",
    "likelihood": "detector.likelihood",
    "log_posterior": "detector.log_posterior",
    "masks": "exposures.masks",
    "matching": "registration.matching",
    "models": "detector.models",
    "photon_transfer": "detector.photon_transfer",
    "posterior": "detector.posterior",
    "residual": "detector.residual",
    "scaling": "exposures.scaling",
}
