"""Array handling of `noiseflow sample`: pieces that fit in memory, data types, and warnings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from noiseflow.models.base import NoiseModelBase
    from noiseflow.progress import Progress

DTYPES = ("auto", "float32", "float64", "uint8", "uint16", "int16")
_FEW = 0.01  # share of the pixels that may lie beyond a limit because of noise alone


def pieces(noise_model: NoiseModelBase, signal: Tensor) -> list[Tensor]:
    """Split the pixels into parts of about a million; whole images if the model needs images, or neighbours correlate. Raises
    ValueError if the model needs images and the signal has fewer than two axes.
    """
    from noiseflow.fitting.signal_models import PART
    from noiseflow.models.correlated import Correlated

    if not (noise_model.needs_image or any(isinstance(part, Correlated) for part in noise_model.modules())):
        return list(torch.split(signal.reshape(-1), PART))
    if signal.ndim < 2:
        raise ValueError(f"{type(noise_model).__name__} needs images; the clean file has one axis; give (y, x)")
    images = signal.reshape(-1, *signal.shape[-2:])
    return list(torch.split(images, max(1, PART // images[0].numel())))


def sample(noise_model: NoiseModelBase, parts: list[Tensor], seed: int, progress: Progress) -> Tensor:
    """Draw noisy pixels for all parts and concatenate them."""
    generator, drawn = torch.Generator(noise_model.device).manual_seed(seed), []
    for part in parts:
        drawn.append(noise_model(part.to(noise_model.device)).sample(generator=generator).cpu())
        progress("Sampling", len(drawn), len(parts), "")
    return torch.cat(drawn)


def read_any(path: Path, output: Path) -> tuple[NDArray[Any], Any]:
    """Read the values of a file and its voxel size. Any number of axes is allowed from one ``.npy`` file to another. Raises
    ValueError as `noiseflow.io.read`.
    """
    from noiseflow import io

    if path.suffix.lower() == output.suffix.lower() == ".npy" and path.is_file():
        try:
            data = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError):  # a damaged file; io.read reports what is wrong
            data = None
        if data is not None and data.ndim > 3 and data.dtype.kind in "buif":
            return data, None
    image = io.read(path)
    return image.data, image.voxel_size


def stored(noisy: NDArray[np.float32], dtype: str, given: np.dtype[Any], noise_model: NoiseModelBase) -> NDArray[Any]:
    """Convert the noisy values to the requested data type. Raises ValueError if an integer type was requested and some values
    are not whole or out of its range.

    `auto` keeps the integer type of the clean file if it holds the values. Otherwise it takes the first of uint16, int16
    and int32 that holds them if the model rounds to whole numbers, and float32 if it does not.
    """
    if dtype in ("float32", "float64"):
        return noisy.astype(dtype)
    kind = given if dtype == "auto" else np.dtype(dtype)
    whole = bool((noisy == np.round(noisy)).all())
    rounds = noise_model.step > 0 and float(noise_model.step).is_integer()
    own = [np.dtype(one) for one in (np.uint16, np.int16, np.int32)] if dtype == "auto" and rounds else []
    for one in (kind, *own) if whole else ():
        if one.kind in "iu" and np.iinfo(one).min <= noisy.min() and noisy.max() <= np.iinfo(one).max:
            return noisy.astype(one)
    if dtype == "auto" or kind.kind not in "iu":
        return noisy.astype(np.float64) if kind == np.float64 else noisy
    raise ValueError(
        f"--dtype {dtype} cannot hold the noisy values, {noisy.min():g} … {noisy.max():g}"
        f"{'' if whole else ', which are not whole numbers'}; use --dtype float32, or a model that rounds and clips (Digitised)"
    )


def notes(noise_model: NoiseModelBase, data: NDArray[Any]) -> list[str]:
    """Warnings about clean pixels outside the range of the model."""
    from noiseflow.metrics.evaluation import num_outside, outside_in_words

    found = outside_in_words(num_outside(noise_model, data), data.size)
    for limit, beyond in ((noise_model.low, data < noise_model.low), (noise_model.high, data > noise_model.high)):
        share = float(beyond.mean())
        if share > _FEW:
            found.append(
                f"{share:.0%} of the clean pixels lie beyond the clipping limit {limit:g} of the model, where its output is "
                f"constant; is the clean image in {noise_model.measured_in}?"
            )
    return found
