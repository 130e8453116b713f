"""The joint fit of volume and noise model."""

from dataclasses import replace
from functools import partial
from typing import Any

from recon.methods._fitted import fitted
from recon.methods._registry import Settings


def _options(settings: Settings, *, required: bool = False) -> dict[str, Any]:
    if settings.noise_model is None:
        if required:
            raise ValueError("--method joint-supervised needs --noise-model FILE; `noiseflow calibrate` makes one")
        return {}
    fixed = settings.noise_model.requires_grad_(False)
    return {"noise_model": lambda: fixed}


METHOD = fitted(
    "joint",
    "Volume and noise model together, with everything chosen by the likelihood of held-out pixels.",
    _options,
    keeps_noise_model=True,
)
METHODS = {
    "auto": replace(METHOD, name="auto", description="The joint fit."),
    "joint-supervised": fitted(
        "joint-supervised",
        "The volume of the joint fit under a calibrated noise model that stays as it is.",
        partial(_options, required=True),
        keeps_noise_model=True,
    ),
}
