"""Tilt angles of a stack or a folder of images: one reader for each kind of file, and one function that joins them to images."""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import imod, tilt_tables
from noiseflow.io.image_file import LARGEST_ANGLE as LARGEST_ANGLE
from noiseflow.io.image_file import ImageFile, TiltTable

_READERS: dict[str, Callable[[Path], TiltTable]] = {
    ".mdoc": tilt_tables.read_mdoc,
    ".star": tilt_tables.read_star,
    ".tomostar": tilt_tables.read_star,
    ".aln": tilt_tables.read_aln,
    ".com": imod.read_commands,
}
"""Readers by suffix; other files are lists of angles."""

RAW_FIRST = (".rawtlt", ".tlt")
REFINED_FIRST = (".tlt", ".rawtlt")
_TABLES = (".tomostar", ".star", ".aln")
_LIST = re.compile(r"(.*[\s_-])?(tilt[\s_-]?)?(angles?|tilts|theta)", re.IGNORECASE)
"""Names of lists of angles, unlike those of logs."""
_STAGES = re.compile(r"_(pre)?ali$|\.ome$", re.IGNORECASE)
_NUMERAL = re.compile(r"[-+]?\d+(\.\d+)?")
_SUFFIX = re.compile(r"\.[A-Za-z]\w{0,4}$")
_PLAUSIBLE = 2.0
"""Degrees by which the nominal and the measured angle of a stage may differ."""


def read_tilts(path: str | Path) -> TiltTable:
    """Read what a file says of the images of a tilt series.

    Args:
        path: a list of angles (``.rawtlt``, ``.tlt``, any text: one angle per line, or the column of a table; comments and
            decimal commas are accepted), SerialEM's ``.mdoc``, AreTomo's ``.aln``, ``.star`` of RELION, ``.tomostar`` of Warp,
            or IMOD's ``tilt.com``.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file holds no angles, or an angle is not a number of degrees.

    Example:
        >>> import noiseflow, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.mdoc"
        >>> _ = path.write_text("[ZValue = 0]\\nTiltAngle = -3\\n[ZValue = 1]\\nTiltAngle = 3\\n")
        >>> noiseflow.io.read_tilts(path).angles.tolist()
        [-3.0, 3.0]
    """
    path = Path(path)
    table = _READERS.get(path.suffix.lower(), imod.read_list)(path)
    if not len(table.angles):
        raise ValueError(f"{path} holds no angles; one angle in degrees per line is required")
    for angle in table.angles:
        if not abs(angle) <= LARGEST_ANGLE:
            raise ValueError(f"{path}: {angle:g} is not a tilt angle; give degrees within ±{LARGEST_ANGLE}")
    return table


def tilts_of(stack: str | Path, image: ImageFile, angles: str | Path | None = None) -> TiltTable:
    """The tilts of the images of a stack or folder, from a file next to it or else from the stack itself.

    Images are joined to angles by name if both have names (``SubFramePath``, ``ImageFile`` or ``[Image = …]`` of an mdoc, movie
    names of a star file), or by the angle in the image's name; otherwise by order.

    Args:
        stack: the file or folder the images were read from. For ``name.st``, the files ``name.rawtlt``, ``name.tlt``,
            ``name.st.mdoc``, ``name.mdoc``, ``name.tomostar``, ``name.star`` and ``name.aln`` are tried; for an aligned stack
            (``.ali``), the refined ``.tlt`` first. For a folder of images, a single such file inside the folder is used, too.
            An IMOD ``tilt.com`` of this stack adds its offset and its excluded views.
        angles: the file of angles, if it is not one of these.

    Returns:
        One row for each image.

    Raises:
        FileNotFoundError: there are no angles in either place.
        ValueError: the angle file cannot be read, or does not match the images.
    """
    file = angle_file_of(stack) if angles is None else Path(angles)
    if file is not None:
        table = read_tilts(file)
        rows = _joined(table, image, file, Path(stack))
        absent = [place for place, row in enumerate(rows) if row < 0]
        table = table.rows([max(row, 0) for row in rows])
        if absent:
            named = f"{len(rows) - len(absent)} of {len(rows)} images of {stack}"
            warnings.warn(f"{file} names {named}; the others are left out", stacklevel=2)
            table = replace(table, excluded=(*table.excluded, *absent))
    elif image.tilt_angles is not None:
        table = TiltTable(image.tilt_angles)
    else:
        names, count = ", ".join(candidate.name for candidate in candidates(stack)[:2]), len(image.data)
        forms = [_NUMERAL.sub("#", name) for name in image.names]
        odd = [name for name, form in zip(image.names, forms, strict=True) if 2 * forms.count(form) < len(forms)]
        unlike = f" ({odd[0]} is not named like most of its images)" if 0 < 2 * len(odd) < len(forms) else ""
        raise FileNotFoundError(
            f"no tilt angles: {stack} does not hold {count} of them, in degrees{unlike}, and no {names} or .mdoc is next to it; "
            "give --angles FILE"
        )
    return table if angles is not None else imod.adjusted(table, Path(stack), bare_stem(Path(stack)))


def _joined(table: TiltTable, image: ImageFile, file: Path, stack: Path) -> list[int]:
    """The row of the table for every image; −1 for sections that it leaves out."""
    count = len(image.data) if image.data.ndim == 3 else 1
    if image.names and table.names and (found := _by_name(table.names, image.names, file, stack)) is not None:
        return found
    if image.names and image.tilt_angles is not None and len(table.angles) >= count:
        found = by_angle(table.angles, image.tilt_angles)
        if found is not None:
            if found != list(range(count)):
                warnings.warn(f"{file} is joined to {stack} by the angles in the names of the images", stacklevel=3)
            return found
    places = {} if table.sections is None else {int(section): row for row, section in enumerate(table.sections)}
    if places and len(places) == len(table.angles) and 0 <= min(places) <= max(places) < count:
        return [places.get(section, -1) for section in range(count)]
    if len(table.angles) != count:
        raise ValueError(
            f"{stack} has {count} images, but there are {len(table.angles)} tilt angles in {file}; "
            f"{advice_on_count(image.data.shape, len(table.angles))}"
        )
    _compare(table.angles, image.tilt_angles, file, stack)
    return list(range(count))


def advice_on_count(shape: Sequence[int], num_angles: int) -> str:
    """What to do about a stack (tilt, y, x) whose number of images is not that of the angles."""
    if list(shape[1:]).count(num_angles) == 1:
        axis = "yx"[list(shape[1:]).index(num_angles)]
        return f"its axis {axis} has {num_angles} entries: save the stack with the tilts first"
    return "give the angle file of these images"


def _by_name(rows: Sequence[str], names: Sequence[str], file: Path, stack: Path) -> list[int] | None:
    """Rows by the names of images; None if no name occurs in the file. Raises ValueError if some images are not named in the
    file, or two images are the same row.
    """
    stems = [file_stem(name) for name in rows]
    patterns = [re.compile(rf"(?<![0-9a-z]){re.escape(stem)}(?![0-9a-z]|\.\d)") for stem in stems]
    found: list[int | None] = []
    for name in map(file_stem, names):
        same = [row for row, stem in enumerate(stems) if stem == name]
        same = same or [row for row, pattern in enumerate(patterns) if stems[row] and pattern.search(name)]
        longest = [row for row in same if len(stems[row]) == max(len(stems[k]) for k in same)]
        found.append(longest[0] if len(longest) == 1 else None)
    known = [row for row in found if row is not None]
    if not known:
        return None
    if len(known) < len(found) or len(set(known)) < len(known):
        wrong = next(k for k, row in enumerate(found) if row is None or found.index(row) < k)
        raise ValueError(
            f"{file} names {len(rows)} images, and {stack} has {len(names)}; {names[wrong]} is not one of those that are "
            "named once: remove this image, or give the file of these images with --angles"
        )
    if len(known) < len(rows):
        warnings.warn(f"{len(rows) - len(known)} of {len(rows)} images of {file} are not in {stack}", stacklevel=4)
    return known


def by_angle(rows: NDArray[np.float64], named: NDArray[np.float64]) -> list[int] | None:
    """Rows by the angles in names of images; None if any is further from its row than half a step or the stage's error."""
    steps = np.diff(np.unique(named))
    nearest = [int(np.abs(rows - angle).argmin()) for angle in named]
    near = min(_PLAUSIBLE, float(steps.min()) / 2) if steps.size else _PLAUSIBLE
    if len(set(nearest)) < len(nearest) or np.abs(rows[nearest] - named).max() > near:
        return None
    return nearest


def names_images(file: Path, names: Sequence[str]) -> bool:
    """Whether a file of angles names these images."""
    rows = read_tilts(file).names
    return bool(rows) and _by_name(rows, names, file, file.parent) is not None


def file_stem(name: str) -> str:
    """The name of a file on any system without folders and suffixes, in lower case."""
    stem = re.split(r"[\\/]", name.strip())[-1]
    while _SUFFIX.search(stem):
        stem = _SUFFIX.sub("", stem)
    return stem.lower()


def angle_file_of(stack: str | Path) -> Path | None:
    """The angle file that `tilts_of` uses; None if there is none. Suffixes may be in capitals."""
    found: dict[Path, dict[str, Path]] = {}
    for candidate in candidates(stack):
        folder = candidate.parent
        if folder not in found:
            found[folder] = {file.name.lower(): file for file in folder.iterdir()} if folder.is_dir() else {}
        file = candidate if candidate.is_file() else found[folder].get(candidate.name.lower())
        if file is not None and _is_table(file):
            return file
    return None


def _is_table(file: Path) -> bool:
    """Whether a file exists; a ``.star`` file must be a table of tilts, as other programs write tables of that name."""
    return file.is_file() and (file.suffix.lower() != ".star" or tilt_tables.has_tilts(file))


def candidates(stack: str | Path) -> list[Path]:
    """Possible angle files of a stack, or of a folder of images, most likely first."""
    stack = Path(str(stack).partition("::")[0])
    if not stack.is_dir():
        return beside(stack)
    stack = stack.resolve()
    inside = [
        file for suffix in (*RAW_FIRST, ".mdoc", *_TABLES) for file in stack.glob(f"*{suffix}") if _is_table(file)
    ]
    named = [file for file in stack.iterdir() if file.suffix.lower() in (".txt", ".csv") and _LIST.fullmatch(file.stem)]
    inside = inside or named
    return [*beside(stack), *(inside if len(inside) == 1 else [])]


def beside(stack: Path) -> list[Path]:
    """Possible angle files of a stack, most likely first."""
    stack = stack.with_suffix("") if stack.suffix.lower() in (".gz", ".bz2") else stack
    refined = stack.suffix.lower() == ".ali" or stack.stem.endswith("_ali")
    stem = stack.with_name(bare_stem(stack) + ".x")
    texts = [stem.with_suffix(suffix) for suffix in (REFINED_FIRST if refined else RAW_FIRST)]
    mdocs = [stack.with_name(stack.name + ".mdoc"), stem.with_suffix(".mdoc")]
    return [*texts, *mdocs, *(stem.with_suffix(end) for end in _TABLES), *(stack.with_suffix(end) for end in RAW_FIRST)]


def bare_stem(stack: Path) -> str:
    """The name of a stack without its suffix and its stage of processing: ``series`` for ``series_preali.mrc``."""
    name = stack.name.removesuffix(".gz").removesuffix(".bz2")
    return _STAGES.sub("", name.removesuffix(Path(name).suffix))


def _compare(angles: NDArray[np.float64], inside: NDArray[np.float64] | None, angle_file: Path, stack: Path) -> None:
    if inside is None or len(inside) != len(angles) or np.abs(inside - angles).max() <= _PLAUSIBLE:
        return
    worst = int(np.abs(inside - angles).argmax())
    warnings.warn(
        f"{angle_file} says {angles[worst]:g}° for section {worst}, {stack} itself {inside[worst]:g}°; "
        "the angle file is used",
        stacklevel=4,
    )
