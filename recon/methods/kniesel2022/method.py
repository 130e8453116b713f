"""The preset as a method of reconstruction."""

from __future__ import annotations

from dataclasses import replace

from recon.joint.signal_model import TomographySignal
from recon.methods._registry import Method, Settings
from recon.methods.kniesel2022.presets import PRESETS
from recon.projection.dual_axis import projector_of
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid


def preset_method(name: str, description: str) -> Method:
    """Wrap a preset of `PRESETS` as a method."""

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        width = tilt_series.images.shape[2]
        if grid.width != width or grid.depth > width:
            raise ValueError(
                f"method {name} fills a cube as wide as the images; give a grid {width} wide and no deeper"
            )
        preset = replace(PRESETS[name], seed=settings.seed, device=settings.device)
        state = preset.start(tilt_series, max_steps=settings.num_steps)
        settings.run_stage(name, state)
        projector = projector_of(tilt_series, grid, settings.device)
        model = TomographySignal(state.field(grid), projector, state.response, weight=0.0)
        volume = Volume(model.volume().cpu().numpy(), grid.voxel_size)
        choices: dict[str, float | str] = {"steps": state.done, "loss": state.loss}
        return Reconstruction(volume, model.images(), name, state.noise_model, signal_model=model, choices=choices)

    return Method(
        name,
        description,
        run,
        learns_noise=True,
        memory=PRESETS[name].memory,
        continuous=True,
        refuses=("second-axis",),
    )


METHOD = preset_method(
    "kniesel2022", "Kniesel et al. 2022 with its own settings and a density that is normalised (days)."
)
