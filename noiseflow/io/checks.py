"""Refusals that name the pixel or the line: what comes after may trust the data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def number(text: str) -> float:
    """A number as instruments write it: without what Python allows besides, such as ``6_0`` or digits of other scripts.

    Raises:
        ValueError: it is none.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"'{text}' is no number")
    return float(text)


class Unsupported(ValueError):
    """A sound file with contents that noiseflow cannot use; the message follows the file's name."""


def as_array(data: Any) -> NDArray[Any]:
    """A NumPy array of an array, a list, or a tensor on any device."""
    return np.asarray(data.detach().cpu() if hasattr(data, "detach") else data)


def require_finite(data: NDArray[Any], name: str | Path) -> None:
    """Refuse NaN and infinite pixels, naming how many there are and where the first one is."""
    if not np.issubdtype(data.dtype, np.floating):
        return
    count = sum(part.size - int(np.isfinite(part).sum()) for part in np.atleast_2d(data))
    if count:
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(data))[0])
        raise ValueError(
            f"{name} has {count} NaN or infinite pixels, the first at {where}; replace them or mask them before this step"
        )


def require_contrast(data: NDArray[Any], name: str | Path) -> None:
    """Refuse an image whose pixels are all equal."""
    if data.size and data.min() == data.max():
        raise ValueError(f"{name} is flat: every pixel is {data.flat[0]}; check that the right file was given")


def require_room(claimed: int, path: Path, *, compressed: bool = False, size: int | None = None) -> None:
    """Refuse pixels that the file cannot hold, before memory is taken for them.

    Args:
        claimed: bytes of pixels that the header promises.
        path: the file.
        compressed: allow a thousand times the file's size; no compression of real images comes near.
        size: bytes stored, where that is not the size of one file.
    """
    stored = path.stat().st_size if size is None else size
    if claimed > (1000 * stored if compressed else stored):
        raise ValueError(f"its header claims {claimed} bytes of pixels; the file has {stored}")


def exactly_as(data: NDArray[Any], kinds: Sequence[type[np.generic]], format_name: str) -> NDArray[Any]:
    """The same values in the first of a format's number types that holds them all.

    Raises:
        ValueError: none does.
    """
    for kind in kinds:
        other = data.astype(kind)
        if np.array_equal(other.astype(data.dtype), data, equal_nan=data.dtype.kind == "f"):
            return other
    raise ValueError(
        f"{format_name} holds no {data.dtype}, and values up to {data.max()} would lose digits; write .npy instead"
    )


def text_lines(path: Path, kind: str, *, holds: str) -> list[str]:
    """The lines of a text file of this kind.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no text.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{kind} {path} {'is no file' if path.exists() else 'does not exist'}; check the path")
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    if "\0" in text:
        raise ValueError(f"{path} is no text; an {kind} holds {holds}")
    return text.splitlines()
