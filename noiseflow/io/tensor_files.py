"""Tensors in safetensors files, written atomically."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from noiseflow.io.files import atomic_path

if TYPE_CHECKING:
    from torch import Tensor


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a file; if writing fails, an existing file is kept.

    Args:
        path: target.
        tensors: contiguous CPU tensors that do not share memory.
        metadata: texts by name.

    Raises:
        OSError: the file cannot be written, for example because the disk is full.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with atomic_path(path) as partial:
        try:
            save_file(tensors, partial, metadata=dict(metadata))
        except SafetensorError as error:  # system errors are only part of its message
            found = re.search(r"os error (\d+)", str(error))
            if found is None:
                raise
            raise OSError(int(found[1]), os.strerror(int(found[1])), str(path)) from error
