"""Tensors in safetensors files, each written whole or not at all."""

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
    """Write a file, or leave what was there.

    Args:
        path: target.
        tensors: on the CPU and contiguous, none sharing memory with another.
        metadata: texts by name.

    Raises:
        OSError: the disk is full, the folder is gone, or the like.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with atomic_path(path) as partial:
        try:
            save_file(tensors, partial, metadata=dict(metadata))
        except SafetensorError as error:  # it tells the system's errors in words only
            found = re.search(r"os error (\d+)", str(error))
            if found is None:
                raise
            raise OSError(int(found[1]), os.strerror(int(found[1])), str(path)) from error
