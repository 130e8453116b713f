"""Plugin for napari (extra ``[napari]``): reads tilt series and volumes, writes volumes, and reconstructs."""

from noiseflow.resources import wait_passively

wait_passively()  # here, because the plugin's own module imports torch
from recon.napari.plugin import get_reader, reconstruct_widget, write_image  # noqa: E402

__all__ = ["get_reader", "reconstruct_widget", "write_image"]
