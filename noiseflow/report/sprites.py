"""Stacks of images as a few compressed sprite sheets for embedding in a page."""

import base64
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.statistics import block_means

_SHEET = 2048
# of WebP; the first, above 100, is lossless; 75 between the others would show a noisy 256³ with 5.0 in place of 6.2 levels rms
_QUALITIES = (101, 90, 60)


@dataclass(frozen=True)
class Sprites:
    """A stack as 8-bit images tiled on sheets.

    Attributes:
        sheets: WebP files; tiles are ordered along rows, with ``columns`` tiles per row and ``per_sheet`` per sheet.
        shape: (section, y, x) as stored.
        original: (section, y, x) before downsampling.
        columns, per_sheet: layout of the tiles.
        low: value of the grey level 0, detector or volume units.
        high: value of the grey level 255, detector or volume units.
        lossless: whether the sheets store the 8-bit values exactly.
    """

    sheets: tuple[bytes, ...]
    shape: tuple[int, int, int]
    original: tuple[int, int, int]
    columns: int
    per_sheet: int
    low: float
    high: float
    lossless: bool

    @property
    def num_bytes(self) -> int:
        """Size in the page, in base64 encoding."""
        return sum(4 * math.ceil(len(sheet) / 3) for sheet in self.sheets)

    def as_json(self) -> dict[str, Any]:
        """The data that the script of the page needs for unpacking."""
        sheets = ["data:image/webp;base64," + base64.b64encode(sheet).decode() for sheet in self.sheets]
        layout = {"shape": list(self.shape), "columns": self.columns, "perSheet": self.per_sheet}
        return layout | {"low": self.low, "high": self.high, "sheets": sheets}

    def in_words(self) -> str:
        """A sentence about the differences between the stored and the original stack."""
        depth = "8-bit grey values" if self.lossless else "8-bit grey values with slightly lossy compression"
        if self.shape == self.original:
            return f"Shown at full size in {depth}."
        sizes = " × ".join(map(str, self.shape)), " × ".join(map(str, self.original))
        return f"Shown at {sizes[0]}, binned from {sizes[1]} to keep this page small, in {depth}."


def make_sprites(
    stack: NDArray[Any],
    *,
    most_bytes: int = 6_000_000,
    limits: tuple[float, float] | None = None,
    keep_sections: bool = False,
) -> Sprites:
    """Pack a stack into sheets of at most 2048² pixels: lossless if small enough, otherwise lossy, otherwise also binned.

    Args:
        stack: (section, y, x), finite.
        most_bytes: largest size of all sheets in base64.
        limits: values of black and white; by default the minimum and maximum.
        keep_sections: bin only y and x, for stacks whose sections are separate views.

    Raises:
        ValueError: the array is not a stack, or pixels are not finite.
    """
    if stack.ndim != 3 or not stack.size:
        raise ValueError(f"give a stack (section, y, x); this array has shape {stack.shape}")
    if not all(np.isfinite(section).all() for section in stack):
        raise ValueError("the stack has NaN or infinite pixels; replace them before drawing it")
    low, high = limits or (float(stack.min()), float(stack.max()))
    high = high if high > low else low + 1.0
    small = np.asarray(stack)
    while True:
        # WebP hardly ever stores ten pixels in a byte, and trying would waste memory
        while max(small.shape[1:]) > _SHEET or (small.size > 10 * most_bytes and max(small.shape[1:]) > 1):
            small = _halved(small, keep_sections)
        grey = np.empty(small.shape, np.uint8)
        for target, section in zip(grey, small, strict=True):
            target[...] = np.clip(np.rint((section.astype(np.float32) - low) * (255 / (high - low))), 0, 255)
        for quality in _QUALITIES:
            if _expected_bytes(grey, quality) <= most_bytes:
                sprites = _packed(grey, quality, stack.shape, (low, high))
                if sprites.num_bytes <= most_bytes:
                    return sprites
        before, small = small.size, _halved(small, keep_sections)
        if small.size == before:
            raise ValueError(f"a stack of shape {stack.shape} needs more than {most_bytes} bytes; increase most_bytes")


def _expected_bytes(grey: NDArray[np.uint8], quality: int, *, probed: int = 6) -> float:
    """Estimate the packed size from a few sections, because packing the whole stack at every quality would take minutes."""
    chosen = grey[np.unique(np.linspace(0, len(grey) - 1, probed).round().astype(int))]
    return _packed(chosen, quality, chosen.shape, (0.0, 1.0)).num_bytes * len(grey) / len(chosen)


def _packed(grey: NDArray[np.uint8], quality: int, original: Any, limits: tuple[float, float]) -> Sprites:
    import cv2

    count, height, width = grey.shape
    columns = min(count, max(1, _SHEET // width))
    per_sheet = min(count, columns * max(1, _SHEET // height))
    sheets = []
    for start in range(0, count, per_sheet):
        tiles = grey[start : start + per_sheet]
        rows = math.ceil(len(tiles) / columns)
        sheet = np.zeros((rows, columns, height, width), np.uint8)
        sheet.reshape(-1, height, width)[: len(tiles)] = tiles
        image = np.ascontiguousarray(sheet.transpose(0, 2, 1, 3)).reshape(rows * height, columns * width)
        _, encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
        sheets.append(encoded.tobytes())
    return Sprites(tuple(sheets), grey.shape, tuple(original), columns, per_sheet, *limits, quality == _QUALITIES[0])


def _halved(stack: NDArray[Any], keep_sections: bool) -> NDArray[np.float32]:
    """The stack binned by 2 × 2 pixels and, unless `keep_sections`, pairs of sections; an odd last one is dropped."""
    sizes = [1 if axis == 0 and keep_sections else min(size, 2) for axis, size in enumerate(stack.shape)]
    return block_means(stack, *sizes).astype(np.float32)
