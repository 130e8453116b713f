"""Parsing of options that the commands of this package share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

    from recon.series.tilt_series import Mode


def parse_mode(text: str) -> Mode:
    """The mode of image formation that `--mode` names.

    Raises:
        ValueError: the mode is unknown.
    """
    modes: dict[str, Mode] = dict.fromkeys(("transmission", "bright-field", "bf"), "transmission")
    modes |= dict.fromkeys(("linear", "haadf", "adf", "edx", "eds"), "linear")
    if text.lower() not in modes:
        raise ValueError(f"--mode {text}: choose transmission (bright field) or linear (HAADF, EDX)")
    return modes[text.lower()]


def method_of(method: str, preset: str | None) -> str:
    """The method that `--method`, in upper or lower case, or `--preset` names.

    Raises:
        ValueError: the preset is unknown, or `--method` is given too.
    """
    from recon.names import method_names

    method = {name.lower(): name for name in method_names()}.get(method.lower(), method)
    if preset is None:
        return method
    from recon.methods.kniesel2022.presets import PRESETS

    if preset not in PRESETS:
        raise ValueError(f"--preset {preset}: choose {' or '.join(PRESETS)}")
    if method not in ("auto", preset):
        raise ValueError(f"--preset {preset} is itself a method; remove --method {method}")
    return preset


def load_noise_model(path: Path | None) -> nn.Module | None:
    """The noise model in a file, or None without a file. Raises as `noiseflow.load`."""
    if path is None:
        return None
    import noiseflow

    return noiseflow.load(path)
