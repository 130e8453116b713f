"""One-line representations of objects: arrays by shape and type, numbers with units, lists by length."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

Kind = TypeVar("Kind")


def printable(text: str) -> str:
    """Replace control and invisible characters by ``?``, except line ends, so that text is safe to print on a terminal."""
    return text if text.isprintable() else "".join(one if one.isprintable() or one == "\n" else "?" for one in text)


def described(**units: str) -> Callable[[type[Kind]], type[Kind]]:
    """Class decorator that gives a dataclass a one-line repr.

    Args:
        **units: units of the fields, by name.
    """

    def decorate(kind: type[Kind]) -> type[Kind]:
        def __repr__(self: Any) -> str:
            parts = []
            for field in fields(self):
                value = getattr(self, field.name)
                unit = f" {units[field.name]}" if field.name in units and value is not None else ""
                parts.append(f"{field.name}={in_short(value)}{unit}")
            return f"{kind.__name__}({', '.join(parts)})"

        kind.__repr__ = __repr__  # type: ignore[method-assign]
        return kind

    return decorate


def in_short(value: Any, *, few: int = 4) -> str:
    """A short description of a value; few numbers are written out."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return size_of(value)
    if isinstance(value, float):
        return f"{value:.5g}"
    if callable(value) and hasattr(value, "__name__"):
        return str(value.__name__)
    if isinstance(value, tuple) and len(value) <= few and all(isinstance(v, (int, float)) for v in value):
        return f"({', '.join(in_short(v) for v in value)})" if not hasattr(value, "_fields") else repr(value)
    if isinstance(value, (Mapping, Sequence)) and not isinstance(value, str):
        return f"<{len(value)} entries>"
    return repr(value)


def bytes_in_words(count: float) -> str:
    """A number of bytes in GiB, or in MiB if that is less than one."""
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


def size_of(array: Any) -> str:
    """Shape and data type of an array or tensor, such as ``64 x 64 float32``."""
    kind = str(array.dtype).removeprefix("torch.")
    if not array.shape:
        return f"{array.item():.5g}"
    return f"{' x '.join(map(str, array.shape))} {kind}"
