"""Input checks whose errors name the pixel or the line."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def number(text: str) -> float:
    """Parse a number as instruments write it; Python's extensions such as ``6_0`` or non-ASCII digits are rejected. Raises
    ValueError if the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"'{text}' is not a number")
    return float(text)


def parse_region(text: str, shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Parse ``z0:z1,y0:y1,x0:x1``, or as many of the last axes as `shape` has; ends may be omitted. Raises ValueError if the form
    is wrong, or the region is not inside."""
    try:
        ends = [[int(end) if end.strip() else None for end in part.split(":")] for part in text.split(",")]
    except ValueError:
        ends = []
    if len(ends) != len(shape) or any(len(pair) != 2 for pair in ends):
        form = ",".join(f"{axis}0:{axis}1" for axis in "zyx"[-len(shape) :])
        raise ValueError(f"--region {text}: give {form} in pixels, such as {','.join(['16:64'] * len(shape))}")
    found = [slice(start or 0, size if stop is None else stop) for (start, stop), size in zip(ends, shape, strict=True)]
    for part, size in zip(found, shape, strict=True):
        if not 0 <= part.start < part.stop <= size:
            raise ValueError(f"--region {text}: {part.start}:{part.stop} is not inside {size} pixels")
    return tuple(found)


def is_colour(shape: tuple[int, ...]) -> bool:
    """Whether an array is one image (y, x, colour), and not frames of so few pixels that x has three or four."""
    return len(shape) == 3 and shape[-1] in (3, 4) and min(shape[:2]) > 4


def grey(data: NDArray[Any]) -> NDArray[Any]:
    """Images (..., y, x, colour) whose colours are equal, as one channel; the last of two or four is the opacity. Raises
    Unsupported if the colours differ, or the opacity varies.
    """
    colours = data.shape[-1] - (data.shape[-1] in (2, 4))
    opacity = data[..., colours:]
    if (data[..., :colours] != data[..., :1]).any() or (opacity != opacity[..., :1, :1, :]).any():
        raise Unsupported(f"is a colour image (shape {data.shape}); save one colour as a grey image")
    return np.ascontiguousarray(data[..., 0])


EXPORT = "open it in Fiji (Bio-Formats) and save it as TIFF"


class Unsupported(ValueError):
    """A valid file with contents that noiseflow cannot use; `read` puts the file's name before the message."""


class SeveralImages(Unsupported):
    """A file holds several images or channels, `names`, and none of them was chosen."""

    def __init__(self, message: str, names: Sequence[str]) -> None:
        super().__init__(message)
        self.names = tuple(names)


def shortened(words: Sequence[str], *, most: int = 12) -> str:
    """The first words of a list, for a message."""
    return ", ".join([*words[:most], *(["…"] if len(words) > most else [])])


def choose(names: Sequence[str], wanted: str | None, kind: str = "images") -> int:
    """Index of the image or channel with a name; `wanted` may also be its index from zero. Raises Unsupported if there is no
    such image; and SeveralImages if none was named, and there are several.
    """
    if wanted is None and len(names) == 1:
        return 0
    if wanted is not None and wanted in names:
        return list(names).index(wanted)
    listed = shortened([f"'{name}'" for name in names])
    if wanted is None:
        raise SeveralImages(f"holds several {kind}: {listed}; name one as FILE::NAME, or with --channel", names)
    if wanted.isascii() and wanted.isdigit() and int(wanted) < len(names):
        return int(wanted)
    raise Unsupported(f"holds no '{wanted}'; available: {listed or 'nothing'}")


def choose_member(names: Sequence[str], shapes: Sequence[tuple[int, ...]], wanted: str | None) -> tuple[int, bool]:
    """Index of the array to read: the named one, or else the largest one, or that with the wanted index among the largest; and
    whether `wanted` chose it. Raises Unsupported if the name does not exist, or there is no image; and SeveralImages if several
    images have the largest size.

    A single array with an axis of channels is chosen whatever is wanted, which may be one of its channels.
    """
    images = [index for index, shape in enumerate(shapes) if len(shape) in (2, 3, 4)]
    if not images:
        raise Unsupported("holds no image or stack")
    if wanted is not None and wanted in names:
        return list(names).index(wanted), True
    sizes = [(len(shapes[index]), int(np.prod(shapes[index], dtype=float))) for index in images]
    largest = [index for index, size in zip(images, sizes, strict=True) if size == max(sizes)]
    if len(largest) == 1 and (wanted is None or len(shapes[largest[0]]) == 4):
        return largest[0], False
    if wanted is None or wanted.isdigit():
        return largest[choose([names[index] for index in largest], wanted)], True
    return choose(names, wanted), True


def require_finite(data: NDArray[Any], name: str | Path) -> None:
    """Raise ValueError if pixels are NaN or infinite; the message gives their number and the first position."""
    if not np.issubdtype(data.dtype, np.floating):
        return
    count = sum(part.size - int(np.isfinite(part).sum()) for part in np.atleast_2d(data))
    if count:
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(data))[0])
        raise ValueError(f"{name} has {count} NaN or infinite pixels, the first at {where}; replace or mask them")


def require_contrast(data: NDArray[Any], name: str | Path) -> None:
    """Raise ValueError if all pixels of an image are equal, or its unit leaves the range of single precision."""
    span = float(data.max()) - float(data.min()) if data.size else 1.0
    if span == 0:
        raise ValueError(f"{name} is flat: every pixel is {data.flat[0]}; check that the right file was given")
    largest = float(np.finfo(np.float32).max)  # of single precision, in which cubes of pixel values are computed
    if not 1 / largest < span * span * span < largest:
        raise ValueError(f"the values of {name} span {span:.2g}; mask wrong ones, or scale all to span 1 to 1000")


def require_room(claimed: int, path: Path, *, compressed: bool = False, size: int | None = None) -> None:
    """Check that a file can hold the pixels that its header claims, before memory is allocated for them.

    Args:
        compressed: allow a thousand times the file size, far more than any compression of real images.
        size: bytes stored, if that is not the size of one file.
    """
    stored = path.stat().st_size if size is None else size
    if claimed > (1000 * stored if compressed else stored):
        raise ValueError(f"its header claims {claimed} bytes of pixels; the file has {stored}")


def exactly_as(data: NDArray[Any], kinds: Sequence[type[np.generic]], format_name: str) -> NDArray[Any]:
    """Convert values to the first data type of a format that represents them exactly. Raises ValueError if no type does."""
    for kind in kinds:
        other = data.astype(kind)
        if np.array_equal(other.astype(data.dtype), data, equal_nan=data.dtype.kind == "f"):
            return other
    raise ValueError(f"{format_name} cannot store {data.dtype} up to {data.max()} exactly; write .npy instead")


def text_lines(path: Path, kind: str, *, holds: str) -> list[str]:
    """The lines of a text file; `kind` names it in errors. Raises FileNotFoundError if the file does not exist, and ValueError
    if it is not text.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{kind} {path} {'is no file' if path.exists() else 'does not exist'}; check the path")
    raw = path.read_bytes()
    text = raw.decode(_encoding(raw[:64]), errors="replace")
    if "\0" in text:
        raise ValueError(f"{path} is not a text file; an {kind} holds {holds}")
    return text.splitlines()


def _encoding(start: bytes) -> str:
    """UTF-16 if a file begins with its mark, or if every second byte is zero, as some Windows programs write it."""
    even, odd = start[::2], start[1::2]
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if odd and not any(odd) and all(even):
        return "utf-16-le"
    return "utf-16-be" if odd and all(odd) and not any(even) else "utf-8-sig"
