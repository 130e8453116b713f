"""TIFF files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.images import ImageFile, VoxelSize


def read(path: Path) -> ImageFile:
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        claimed = sum(page.nbytes for page in tiff.pages)
        limit = 1000 * path.stat().st_size + 2**20  # no compression of real images comes near
        if claimed > limit:
            raise ValueError(f"its header claims {claimed} bytes of pixels")
        series = tiff.series[0]
        data = series.asarray()
        spacing = (tiff.imagej_metadata or {}).get("spacing")
        unit = (tiff.imagej_metadata or {}).get("unit")
        page = tiff.pages[0]
        tags: Any = page.tags if isinstance(page, tifffile.TiffPage) else {}
        resolution = [tags[name].value for name in ("YResolution", "XResolution") if name in tags]
    if unit == "angstrom" and spacing and len(resolution) == 2:
        y, x = (denominator / numerator for numerator, denominator in resolution)
        return ImageFile(data, (float(spacing), y, x))
    return ImageFile(data)


def write(path: Path, data: NDArray[Any], voxel_size: VoxelSize | None) -> None:
    import tifffile

    if voxel_size is None:
        tifffile.imwrite(path, data, photometric="minisblack")  # or a stack of three would be stored as colour
        return
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    z, y, x = voxel_size
    tifffile.imwrite(path, data, imagej=True, resolution=(1 / x, 1 / y), metadata={"spacing": z, "unit": "angstrom"})
