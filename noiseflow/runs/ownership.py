"""Marks in output files. Files without the mark of this program are not overwritten without `--overwrite`.

The mark is the last label of an MRC header, the ``Software`` tag of a TIFF file, ``_creator`` in the attributes of a Zarr group,
the format name in a safetensors file, ``Software`` in a PNG file, ``generator`` in a page, and the first line of a table;
the table of a batch is known by its columns. An ``.npy`` header has no room for text: ours is padded to 1024 bytes, which every
reader skips and no other program writes. Angle files belong to the stack next to them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from noiseflow.installation import library_version

MARK = "noiseflow"
NPY_HEADER_BYTES = 1024
_PAGE_HEAD = 1000
_BATCH_COLUMNS = b"series,volume,status,verdict,reason,error,"


def signature() -> str:
    """The mark with the version, such as ``noiseflow 0.1.0``."""
    return f"{MARK} {library_version()}"


def require_own(path: Path, *, overwrite: bool) -> None:
    """Check that an output does not replace a file that this program did not write.

    Args:
        path: an output; missing and empty files are accepted.
        overwrite: accept any file.

    Raises:
        FileExistsError: the file exists and this program did not write it.
    """
    # existence is checked last, in case the file is deleted in the meantime
    if not overwrite and not is_own(path) and path.exists():
        raise FileExistsError(
            f"{path} exists and was not written by noiseflow; name another output, or replace it with --overwrite"
        )


def is_own(path: Path) -> bool:
    """Whether a file or Zarr folder carries the mark of this program, or is an empty file."""
    from noiseflow.io.image_file import MRC_SUFFIXES, TIFF_SUFFIXES

    kind = path.suffix.lower()
    try:
        if path.is_dir():
            return kind == ".zarr" and _zarr_is_own(path)
        if path.stat().st_size == 0:
            return True
        if kind in (".rawtlt", ".tlt"):
            return (stack := path.with_suffix(".mrc")).is_file() and is_own(stack)
        if kind in TIFF_SUFFIXES:
            return _tiff_is_own(path)
        if kind == ".safetensors":
            return (tensors_format(path) or "").startswith(MARK)
        with path.open("rb") as stream:
            head = stream.read(1024)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return False
    if kind in MRC_SUFFIXES:
        last = 224 + 80 * (int.from_bytes(head[220:224], "little") - 1)
        return head[last : last + 80].startswith(MARK.encode())
    if kind == ".npy":
        return head[:10] == npy_start()
    if kind == ".png":
        return b"tEXtSoftware\0" + MARK.encode() in head
    if kind == ".csv":
        return head.startswith((f"# {MARK} ".encode(), _BATCH_COLUMNS))
    if kind == ".json":
        return f'"written_by": "{MARK}'.encode() in head
    return kind == ".html" and f'name="generator" content="{MARK}'.encode() in head[:_PAGE_HEAD]


def npy_start() -> bytes:
    """The first bytes of our ``.npy`` files: magic string, version 1.0 and header length."""
    return b"\x93NUMPY\x01\x00" + (NPY_HEADER_BYTES - 10).to_bytes(2, "little")


def _zarr_is_own(path: Path) -> bool:
    description: dict[str, Any] = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    return str(description["attributes"]["_creator"]["name"]) == MARK


def _tiff_is_own(path: Path) -> bool:
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        tags: Any = tiff.pages.first.tags
        return str(tags["Software"].value).startswith(MARK)


def tensors_format(path: Path) -> str | None:
    """The format name in the metadata of a safetensors file; None if there is no such file or no name."""
    try:
        with path.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if length > path.stat().st_size:
                return None
            header: dict[str, Any] = json.loads(stream.read(length))
        return str(header["__metadata__"]["format"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
