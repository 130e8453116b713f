"""MRC files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.images import ImageFile, VoxelSize


def read(path: Path) -> ImageFile:
    import mrcfile

    with mrcfile.open(path, header_only=True) as header_only:
        header = header_only.header
        count = int(header.nx) * int(header.ny) * int(header.nz)
        mode = mrcfile.utils.data_dtype_from_header(header)
        expected = count * mode.itemsize + 1024 + int(header.nsymbt)
    size = path.stat().st_size
    if min(header.nx, header.ny, header.nz) < 1 or expected > size:
        raise ValueError(
            f"its header claims {header.nx} x {header.ny} x {header.nz} pixels, {expected} bytes; the file has {size}"
        )
    with mrcfile.open(path) as mrc:
        data = np.array(mrc.data)
        x, y, z = (float(mrc.voxel_size[axis]) for axis in "xyz")
    return ImageFile(data, (z, y, x) if min(x, y, z) > 0 else None)


def write(path: Path, data: NDArray[Any], voxel_size: VoxelSize | None) -> None:
    import mrcfile

    if data.dtype in (np.float64, np.int32, np.int64, np.uint32):
        data = data.astype(np.float32)
    with mrcfile.new(path, data=np.ascontiguousarray(data), overwrite=True) as mrc:
        if voxel_size is not None:
            mrc.voxel_size = voxel_size[::-1]
