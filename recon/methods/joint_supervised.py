"""The joint fit with a fixed, calibrated noise model."""

from __future__ import annotations

from typing import Any

from recon.methods._fitted import fitted
from recon.methods._registry import Settings


def _options(settings: Settings) -> dict[str, Any]:
    if settings.noise_model is None:
        raise ValueError("--method joint-supervised needs --noise-model FILE; `noiseflow calibrate` makes one")
    fixed = settings.noise_model.requires_grad_(False)
    return {"noise_model": lambda: fixed}


METHOD = fitted(
    "joint-supervised",
    "The volume of the joint fit under a calibrated noise model that stays as it is.",
    _options,
    keeps_noise_model=True,
)
