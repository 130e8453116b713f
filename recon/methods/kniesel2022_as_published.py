"""Kniesel et al. 2022 to the letter, its log-density included, which does not integrate to one."""

from recon.methods.kniesel2022.method import preset_method

METHOD = preset_method(
    "kniesel2022-as-published", "Kniesel et al. 2022 to the letter; its log-density does not integrate to one (days)."
)
