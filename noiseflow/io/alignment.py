"""Alignments of a tilt series: reading and applying IMOD's ``.xf`` files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from noiseflow.io.checks import number, text_lines


def read_transforms(path: str | Path) -> NDArray[np.float64]:
    """Read an IMOD ``.xf`` file.

    Args:
        path: text file, one line ``A11 A12 A21 A22 DX DY`` per section.

    Returns:
        (section, 2, 3): the matrix A and the shift in pixels, in the order (x, y) of IMOD.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a line does not hold six numbers, a matrix is not invertible, or the file is empty.
    """
    path = Path(path)
    rows = []
    for count, line in enumerate(text_lines(path, "alignment file", holds="six numbers per line"), 1):
        if not line.strip():
            continue
        try:
            a11, a12, a21, a22, dx, dy = map(number, line.split())
        except ValueError:
            raise ValueError(f"{path} line {count}: six numbers A11 A12 A21 A22 DX DY are needed") from None
        row = np.array([[a11, a12, dx], [a21, a22, dy]])
        if not np.isfinite(row).all() or abs(np.linalg.det(row[:, :2])) < 1e-6:
            raise ValueError(f"{path} line {count}: this transform is not invertible; check the alignment file")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no transforms; one line of six numbers per section is required")
    return np.stack(rows)


def apply_transforms(images: NDArray[Any], transforms: NDArray[np.float64]) -> NDArray[np.float32]:
    """Transform every image as IMOD's ``newstack -xform`` does: (x', y') = A·(x − c) + (DX, DY) + c.

    Images are interpolated with cubic splines, which correlates the noise of neighbouring pixels. Regions outside the original
    image are filled with its mean.

    Args:
        images: (section, y, x).
        transforms: (section, 2, 3) from `read_transforms`; c is the centre of the image.

    Returns:
        (section, y, x), in a temporary file if it is large.

    Raises:
        OSError: the disk does not have enough space for that file.
        ValueError: the numbers of transforms and images differ.
    """
    from scipy.ndimage import affine_transform

    if len(images) != len(transforms):
        raise ValueError(f"there are {len(images)} images and {len(transforms)} transforms; give the .xf of this stack")
    centre = (np.array(images.shape[1:]) - 1) / 2
    moved = mapped.temporary_map(images.shape, np.float32, in_memory=mapped.IN_MEMORY)
    for image, transform, target in zip(images, transforms, moved, strict=True):
        back = np.linalg.inv(transform[::-1, 1::-1])  # (y, x), from output to input
        offset = centre - back @ (centre + transform[::-1, 2])
        source = image.astype(np.float64)
        affine_transform(source, back, offset, output=target, order=3, mode="constant", cval=float(source.mean()))
    return moved
