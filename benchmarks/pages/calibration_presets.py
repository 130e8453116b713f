"""Exposures of the cameras that the package getframes simulates (pip install getframes): their presets as cases of known gain."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.calibration.simulators import RATIO, Case, random_scene

SIZE = 512
"""Pixels per side: the 90 % interval of the gain then reaches about 1 % either way, half of what a row may be off."""

EXPOSURE = 0.1
"""Seconds of a short exposure, in which dark current and hot pixels are negligible."""

PRESETS: dict[str, bool] = {
    "generic_ccd": True,
    "generic_cmos": True,
    "andor_ikon_m934": True,
    "zwo_asi2600mm": True,
    "generic_scmos": False,
    "hamamatsu_orca_fusion": False,
    "photometrics_prime_95b": False,
    "generic_emccd": False,
}
"""Whether the pixels of a camera are alike, so that an ordinary calibration must raise no alarm."""


def cases() -> dict[str, Callable[[int], Case]]:
    """A pair of each preset; none where getframes is not installed."""
    try:
        import getframes
    except ModuleNotFoundError:
        return {}
    return {f"getframes {name}": _maker(getframes, name, clean) for name, clean in PRESETS.items()}


def _maker(getframes: Any, name: str, clean: bool) -> Callable[[int], Case]:
    def made(seed: int) -> Case:
        noise = zlib.crc32(f"{name} {seed}".encode())
        scene = random_scene(np.random.default_rng(noise), SIZE)
        camera = getframes.Camera.from_preset(name).with_config(resolution=scene.shape)
        config = camera.config
        multiplied = config.em_gain > 1
        electrons = scene / 10 if multiplied else scene
        ratio = 4.0 if multiplied else RATIO
        rate = electrons / config.quantum_efficiency / EXPOSURE
        short, long = (
            np.asarray(camera.expose(rate, EXPOSURE * times, seed=noise + round(times)).data, float)
            for times in (1.0, ratio)
        )
        excess = (2 - 1 / config.em_gain) if multiplied else 1.0
        return Case(short, long, gain=config.em_gain * excess / config.gain_e_per_adu, clean=clean)

    return made
