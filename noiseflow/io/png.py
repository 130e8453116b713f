"""PNG files with one grey image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from noiseflow.io.checks import Unsupported, grey, require_room
from noiseflow.io.image_file import ImageFile

_GREY = {"1": np.uint8, "L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.uint16}
"""Data types of Pillow's grey modes; the mode of 16-bit images depends on its version."""
_COLOURS = ("LA", "RGB", "RGBA")


def read(path: Path) -> ImageFile:
    """Read a grey image of 1, 8 or 16 bits, or one of 8 bits in equal colours."""
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as image:
        with path.open("rb") as stream:
            depth = stream.read(25)[24]  # Pillow halves colours of 16 bits
        if image.mode not in _GREY and (image.mode not in _COLOURS or depth != 8):
            raise Unsupported(
                f"is a PNG file with colour or transparency (mode {image.mode}); "
                "convert it to one grey channel of 8 or 16 bits first"
            )
        if getattr(image, "n_frames", 1) > 1:
            raise Unsupported("is an animated PNG file; save its images as a TIFF stack")
        require_room(image.width * image.height * len(image.getbands()), path, compressed=True)
        if image.mode in _COLOURS:
            return ImageFile(grey(np.asarray(image)))
        return ImageFile(np.asarray(image).astype(_GREY[image.mode]))
