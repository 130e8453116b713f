"""The preset as a method of reconstruction."""

from __future__ import annotations

from dataclasses import replace

import torch

from recon.methods._classical import LineIntegralProblem
from recon.methods._registry import Method, Settings
from recon.methods.kniesel2022.presets import PRESETS
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries, VolumeGrid


def preset_method(name: str, description: str) -> Method:
    """Wrap a preset of `PRESETS` as a method."""

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        preset = replace(PRESETS[name], seed=settings.seed, device=settings.device)
        state = preset.start(tilt_series, max_steps=settings.num_steps)
        settings.run_stage(name, state)
        volume = state.volume(grid)
        predicted = LineIntegralProblem.of(tilt_series, grid).predict(torch.from_numpy(volume.attenuation))
        choices: dict[str, float | str] = {"steps": state.done, "loss": state.loss}
        return Reconstruction(volume, predicted, name, noise_model=state.noise_model, choices=choices)

    return Method(name, description, run, learns_noise=True, refuses=("second axis",))


METHOD = preset_method(
    "kniesel2022", "Kniesel et al. 2022 with its own settings and a density that is normalised (days)."
)
