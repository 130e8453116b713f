"""Plugin for napari (extra ``[napari]``): reads tilt series and volumes, writes volumes, and reconstructs."""

from __future__ import annotations

from recon.napari.files import get_reader, write_image
from recon.napari.widget import reconstruct_widget

__all__ = ["get_reader", "reconstruct_widget", "write_image"]
