"""Alignments as files: JSON with everything, or IMOD's ``.xf`` with a ``.tlt`` next to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from noiseflow import io
from noiseflow.io.ownership import signature
from recon.series.alignment import Alignment
from recon.series.tilt_series import TiltSeries, write_angles

ALIGNMENT_SUFFIXES = frozenset({".json", ".xf"})


def write_alignment(path: str | Path, alignment: Alignment) -> list[Path]:
    """Write an alignment; return the paths of the files.

    Args:
        path: ``.json`` keeps everything; ``.xf`` is for IMOD and is accompanied by a ``.tlt`` file of the same name.
        alignment: the alignment.

    Raises:
        ValueError: the name has another suffix.

    Example:
        >>> import numpy as np, pathlib, recon, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "needle.json"
        >>> alignment = recon.Alignment(3.0, np.zeros((2, 2)), np.array([-30.0, 30.0]))
        >>> [file.name for file in recon.write_alignment(path, alignment)]
        ['needle.json']
        >>> recon.read_alignment(path).tilt_axis
        3.0
    """
    path = Path(path)
    if path.suffix.lower() not in ALIGNMENT_SUFFIXES:
        raise ValueError(f"{path}: write an alignment to a .json file, or to an .xf file for IMOD")
    if path.suffix.lower() == ".json":
        with io.atomic_path(path) as partial:
            text = json.dumps({"written_by": signature(), "alignment": alignment.as_dict()}, indent=1)
            partial.write_text(text + "\n", encoding="utf-8", newline="\n")
        return [path]
    rows = alignment.transforms[:, :, [0, 1, 2]]
    with io.atomic_path(path) as partial:
        numbers = ([*row[:, :2].ravel(), *row[:, 2]] for row in rows)
        lines = (
            "".join(f"{value:12.7f}" for value in line[:4]) + "".join(f"{value:12.3f}" for value in line[4:])
            for line in numbers
        )
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    refined = alignment.tilt_angles if alignment.refined_angles is None else alignment.refined_angles
    return [path, write_angles(path.with_suffix(".tlt"), refined)]


def read_alignment(path: str | Path, tilt_series: TiltSeries | None = None) -> Alignment:
    """Read an alignment that `write_alignment` or IMOD wrote.

    Args:
        path: ``.json``, or ``.xf``; a ``.tlt`` file of the same name gives the refined tilt angles.
        tilt_series: the raw series, in the order of the lines of an ``.xf`` file, which holds no angles.

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
        return _of_imod(path, tilt_series)
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
        )
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist; write it with --save-alignment") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not an alignment that --save-alignment wrote ({error})") from error


def _of_imod(path: Path, tilt_series: TiltSeries | None) -> Alignment:
    transforms, angle_file = io.read_transforms(path), path.with_suffix(".tlt")
    refined = io.read_angles(angle_file) if angle_file.is_file() else None
    if tilt_series is None and refined is None:
        raise FileNotFoundError(
            f"{path} holds no tilt angles and there is no {angle_file.name} next to it; add this file"
        )
    raw = refined if tilt_series is None else tilt_series.tilt_angles
    assert raw is not None
    for other, name in ((raw, "the series"), (refined, angle_file.name)):
        if other is not None and len(other) != len(transforms):
            raise ValueError(
                f"{path} has {len(transforms)} transforms, and {name} has {len(other)} tilts; give the .xf of this series"
            )
    return Alignment.of_transforms(transforms, raw, refined_angles=refined)


def _array(values: Any) -> Any:
    return None if values is None else np.array(values, dtype=np.float64)
