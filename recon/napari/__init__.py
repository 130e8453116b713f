"""Plugin for napari (extra ``[napari]``): reads tilt series and volumes, writes volumes, and reconstructs."""

from noiseflow.resources import wait_passively

wait_passively()  # here, because the plugin's own modules import torch
from recon.napari.files import get_reader, write_image  # noqa: E402
from recon.napari.widget import reconstruct_widget  # noqa: E402

__all__ = ["get_reader", "reconstruct_widget", "write_image"]
