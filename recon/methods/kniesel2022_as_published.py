"""Kniesel et al. 2022 exactly as published, including the log-density, which does not integrate to one."""

from recon.methods.kniesel2022.presets import preset_method

METHOD = preset_method(
    "kniesel2022-as-published",
    "Kniesel et al. 2022 exactly as published; its log-density does not integrate to one (days).",
)
