"""The command `noiseflow export`."""

from pathlib import Path
from typing import Annotated

import typer

from noiseflow.commands.console import JsonOption, Output, OverwriteOption, output_file
from noiseflow.runs.outputs import Outputs


def export(
    field: Annotated[Path, typer.Argument(help="Field of `noiseflow reconstruct --save-field` (.safetensors).")],
    out: Annotated[Path, output_file("Volume to write: .mrc, .rec, .tif, .npy or .zarr.")],
    voxel_size: Annotated[float | None, typer.Option(help="Edge of the voxels, Å; that of the fit by default.")] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
) -> None:
    """Write the volume of a field, with voxels of any size."""
    from recon.fields.fields import load_field, sampled_volume
    from recon.scale.memory import sampled_memory

    output = Output(json)
    with Outputs(field, overwrite=overwrite) as outputs:
        outputs.file(out)
        outputs.options(out)
        loaded = load_field(field)
        if voxel_size is not None and loaded.voxel_size is not None:
            sampled_memory(loaded.shape, voxel_size, loaded.voxel_size)
        volume = sampled_volume(loaded, voxel_size)
        volume.write(out)
    sizes = " x ".join(str(size) for size in volume.attenuation.shape)
    size = "unknown size" if volume.voxel_size is None else f"{volume.voxel_size:.4g} Å"
    output.line(f"volume: {out}, {sizes} voxels (z, y, x) of {size}")
    output.result({"volume": out, "shape": list(volume.attenuation.shape), "voxel_size": volume.voxel_size})
