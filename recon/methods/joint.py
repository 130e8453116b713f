"""The joint fit of volume and noise model."""

from __future__ import annotations

from typing import Any

from recon.methods._fitted import fitted
from recon.methods._registry import Settings


def _options(settings: Settings) -> dict[str, Any]:
    if settings.noise_model is None:
        return {}
    fixed = settings.noise_model.requires_grad_(False)
    return {"noise_model": lambda: fixed}


METHOD = fitted(
    "joint",
    "Volume and noise model together, with everything chosen by the likelihood of held-out pixels.",
    _options,
    keeps_noise_model=True,
)
