"""Alignments as files: JSON with everything, IMOD's ``.xf`` with a ``.tlt``, AreTomo's ``.aln``, RELION's ``.star``."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.io.imod import adjusted
from noiseflow.runs.outputs import require_ending
from noiseflow.runs.ownership import signature
from recon.names import ALIGNMENTS
from recon.series.alignment import Alignment
from recon.series.files import write_angles
from recon.series.tilt_series import TiltSeries
from recon.series.views import HARMLESS

_RAW = (".st", ".mrc", ".mrcs")


def write_alignment(path: str | Path, alignment: Alignment) -> list[Path]:
    """Write an alignment; return the paths of the files.

    Args:
        path: ``.json`` keeps everything; ``.xf`` is for IMOD and is accompanied by a ``.tlt`` file of the same name.

    Raises:
        ValueError: the name has another suffix.

    Example:
        >>> import numpy as np, pathlib, recon, tempfile
        >>> alignment = recon.Alignment(3.0, np.zeros((2, 2)), np.array([-30.0, 30.0]))
        >>> [path] = recon.write_alignment(pathlib.Path(tempfile.mkdtemp()) / "needle.json", alignment)
        >>> recon.read_alignment(path).tilt_axis
        3.0
    """
    path = Path(path)
    require_ending(path, ALIGNMENTS)
    if path.suffix.lower() == ".json":
        with io.atomic_path(path) as partial:
            text = json.dumps({"written_by": signature(), "alignment": alignment.as_dict()}, indent=1)
            partial.write_text(text + "\n", encoding="utf-8", newline="\n")
        return [path]
    matrices, moves = alignment.transforms[:, :, :2], alignment.transforms[:, :, 2]
    with io.atomic_path(path) as partial:
        np.savetxt(partial, np.column_stack([matrices.reshape(-1, 4), moves]), "%12.7f" * 4 + "%12.3f" * 2)
    refined = alignment.tilt_angles if alignment.refined_angles is None else alignment.refined_angles
    return [path, write_angles(path.with_suffix(".tlt"), refined)]


def read_alignment(
    path: str | Path, tilt_series: TiltSeries | None = None, *, binning: float | None = None
) -> Alignment:
    """Read an alignment that `write_alignment` or another program wrote.

    Args:
        path: ``.json``; IMOD's ``.xf``, where a ``.tlt`` file of the same name gives the refined tilt angles, and a raw stack
            of the same name (``.st``, ``.mrc``) the size of the images it was made on; AreTomo's ``.aln``; RELION's ``.star``.
        tilt_series: the raw series, in the order of the stack that was aligned.
        binning: how many times smaller the images are than those that were aligned, if no file states it. Not for ``.json``.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not an alignment, or does not match the series.

    Example:
        >>> import numpy as np, pathlib, recon, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "series.xf"
        >>> _ = path.write_text("1 0 0 1 2.5 0\\n" * 3)
        >>> series = recon.TiltSeries(np.random.default_rng(0).random((3, 8, 8)), [-30.0, 0.0, 30.0], mode="linear")
        >>> recon.read_alignment(path, series).shifts[0, 1].item()  # pixels along x
        -2.5
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return _of_table(path, tilt_series, binning)
    try:
        known = json.loads(path.read_text(encoding="utf-8"))["alignment"]
        return Alignment(
            float(known["tilt_axis_degrees"]),
            np.array(known["shifts_yx_pixels"], dtype=np.float64).reshape(-1, 2),
            np.array(known["tilt_angles_degrees"], dtype=np.float64),
            stretches=_array(known["stretches_yx"]),
            refined_angles=_array(known["refined_angles_degrees"]),
            image_shape=None if known["image_shape_yx"] is None else tuple(known["image_shape_yx"]),
            pixel_size=known["pixel_size_angstrom"],
            x_tilt=float(known.get("x_tilt_degrees", 0.0)),
        )
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist; write it with --save-alignment") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not an alignment that --save-alignment wrote ({error})") from error


def _of_table(path: Path, tilt_series: TiltSeries | None, binning: float | None) -> Alignment:
    """The alignment of a file with one transform for each image of a stack."""
    tables = (".aln", ".star", ".tomostar", ".mdoc", ".com")  # others are transforms, such as .xf and .prexg of IMOD
    table = io.read_tilts(path) if path.suffix.lower() in tables else _xf_with_angles(path, tilt_series)
    _transforms(table, path)
    table = table.rows([row for row in range(len(table.angles)) if row not in table.excluded])
    size = table.pixel_size
    if table.in_angstrom:  # RELION states the size in another file
        size = size or (None if tilt_series is None else tilt_series.pixel_size)
        if size is None:
            raise ValueError(f"{path} states shifts in Å, and no file states the pixel size; give it with --pixel-size")
        table = _scaled(table, size, path)
    known: dict[str, Any] = {"image_shape": table.image_shape, "pixel_size": size}
    if binning is not None:
        if not 0 < binning < np.inf:
            raise ValueError(f"--alignment-binning {binning:g}: give a positive number, such as 4")
        table, known = _scaled(table, binning, path), {}
    if tilt_series is None:
        return Alignment.of_transforms(_transforms(table, path), table.angles, x_tilt=table.x_tilt, **known)
    views = np.arange(tilt_series.num_tilts) if tilt_series.views is None else tilt_series.views
    total = tilt_series.num_views or tilt_series.num_tilts
    sections = np.arange(len(table.angles)) if table.sections is None else table.sections
    if (table.sections is None and len(sections) != total) or sections.max() >= total:
        raise ValueError(
            f"{path} has {len(sections)} transforms, and the series has {total} images; give the alignment of this series"
        )
    rows = {int(section): row for row, section in enumerate(sections)}
    used = [tilt for tilt, view in enumerate(views) if int(view) in rows]
    table = table.rows([rows[int(views[tilt])] for tilt in used])
    refined = None if np.isnan(table.angles).any() else table.angles
    raw, turned = tilt_series.tilt_angles[used], table.x_tilt
    if refined is not None and np.abs(refined + raw).max() < np.abs(refined - raw).max():  # --invert-tilt
        refined, turned = -refined, -turned
    if refined is not None and (apart := float(np.abs(refined - raw).max(initial=0.0))) > HARMLESS["direction"]:
        warnings.warn(
            f"the refined tilt angles of {path.stem} are used, up to {apart:.2f}° from those of the series",
            stacklevel=3,
        )
    alignment = Alignment.of_transforms(_transforms(table, path), raw, refined_angles=refined, x_tilt=turned, **known)
    largest, edge = float(np.abs(alignment.shifts).max(initial=0.0)), min(tilt_series.images.shape[1:])
    # if no file says which images were aligned
    if binning is None and not any(known.values()) and largest > HARMLESS["shift"] * edge:
        warnings.warn(
            f"{path} shifts images of {edge} pixels by up to {largest:.0f} pixels; if it was made on larger images, give "
            "--alignment-binning, or put the stack that was aligned next to it",
            stacklevel=3,
        )
    return alignment


def _scaled(table: io.TiltTable, pixel: float, path: Path) -> io.TiltTable:
    """The table with shifts in larger pixels."""
    return replace(table, transforms=_transforms(table, path) / np.array([1, 1, pixel]))


def _transforms(table: io.TiltTable, path: Path) -> NDArray[np.float64]:
    if table.transforms is None:
        raise ValueError(f"{path} holds tilt angles but no alignment; give it with --angles")
    return table.transforms


def _xf_with_angles(path: Path, tilt_series: TiltSeries | None) -> io.TiltTable:
    """Transforms of IMOD, with the refined angles of the ``.tlt`` and the size of the raw stack of the same name."""
    transforms, angle_file = io.read_transforms(path), path.with_suffix(".tlt")
    refined = io.read_tilts(angle_file).angles if angle_file.is_file() else None
    if refined is None and tilt_series is None:
        raise FileNotFoundError(f"{path} holds no tilt angles and no {angle_file.name} is next to it; add this file")
    if refined is not None and len(refined) != len(transforms):
        raise ValueError(
            f"{path} has {len(transforms)} transforms, and {angle_file} has {len(refined)} angles; give the files of one series"
        )
    unknown = io.TiltTable(np.full(len(transforms), np.nan))
    known = unknown if refined is None else adjusted(io.TiltTable(refined), path, path.stem)  # the offset of tilt.com
    table = replace(unknown, angles=known.angles, transforms=transforms, x_tilt=known.x_tilt)
    stack = next((each for suffix in _RAW if (each := path.with_suffix(suffix)).is_file()), None)
    if stack is None:
        return table
    raw = io.read(stack, mapped=True)
    if len(raw.data) != len(transforms) or raw.data.ndim != 3:
        return table
    size = raw.voxel_size
    return replace(table, image_shape=raw.data.shape[1:], pixel_size=None if size is None else size[2])


def _array(values: Any) -> Any:
    return None if values is None else np.array(values, dtype=np.float64)
