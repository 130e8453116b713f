"""PNG files with one grey image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from noiseflow.io.checks import Unsupported, require_room
from noiseflow.io.image_file import ImageFile

_GREY = {"1": np.uint8, "L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.uint16}
"""Data types of Pillow's grey modes; the mode of 16-bit images depends on its version."""


def read(path: Path) -> ImageFile:
    """Read a grey image of 1, 8 or 16 bits."""
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as image:
        if image.mode not in _GREY:
            raise Unsupported(
                f"is a PNG file with colour or transparency (mode {image.mode}); "
                "convert it to one grey channel of 8 or 16 bits first"
            )
        if getattr(image, "n_frames", 1) > 1:
            raise Unsupported("is an animated PNG file; save its images as a TIFF stack")
        require_room(image.width * image.height, path, compressed=True)
        return ImageFile(np.asarray(image).astype(_GREY[image.mode]))
