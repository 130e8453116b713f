"""Reading of exposure pairs, bursts and levels from files."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Burst, ExposurePair, require_same_size
from noiseflow.io import read
from noiseflow.io.checks import is_colour, parse_region


def frames_of(path: str | Path, *, channel: str | None = None, alike: float = 0.8) -> tuple[NDArray[Any], str]:
    """Read the frames of a file, and return them with the file's name for messages.

    Arrays whose last axis counts the frames, as in MATLAB, are recognised: successive frames of one scene differ less than
    neighbouring pixels.

    Args:
        channel: name or index of one channel or image, if there are several, of which none is taken unasked.
        alike: mean squared difference of successive slices along the last axis, relative to that along the first, below which
            the last axis counts the frames; 1 for pure noise.
    """
    data, name = read(path, channel=channel).data, str(path)
    if is_colour(data.shape):
        raise ValueError(f"{path} is a colour image (shape {data.shape}); save one colour as a grey image")
    if data.ndim == 3 and 1 < data.shape[2] < min(data.shape[:2]):
        first, last = (float(np.mean(np.square(np.diff(data.astype(np.float64), axis=axis)))) for axis in (0, 2))
        if last < alike * first:
            return np.moveaxis(data, 2, 0), f"{name} (axes y, x, frame)"
    return data, name


def read_pairs(
    short: str | Path | Sequence[str | Path],
    long: str | Path | Sequence[str | Path],
    *,
    exposure_ratio: float | None = None,
    channel: str | None = None,
) -> list[ExposurePair]:
    """Read exposure pairs in the order given.

    Args:
        short: file or files of the short exposures.
        long: file or files of the long exposures: one per short exposure, or one for all.
        exposure_ratio: exposure ratio of every pair; None if unknown.
        channel: see `frames_of`.

    Raises:
        FileNotFoundError: a file does not exist.
        TypeError: arrays are given.
        ValueError: the lists do not match, a file cannot be read, or `ExposurePair` rejects a pair.

    Example:
        >>> import calibration, noiseflow, pathlib
        >>> folder = pathlib.Path(noiseflow.__file__).parent / "data" / "exposures_miro"
        >>> pairs = calibration.read_pairs([folder / "channel1_050ms.tif"], [folder / "channel1_long.tif"])
        >>> pairs[0].short.shape
        (400, 400)
    """
    short, long = _files(short), _files(long)
    if len(long) not in (1, len(short)) or not short:
        raise ValueError(f"{len(short)} short and {len(long)} long exposures were given; give one long for each or all")
    longs = list(long) * (len(short) if len(long) == 1 else 1)
    for one, other in zip(short, longs, strict=True):
        if Path(one).resolve() == Path(other).resolve():
            raise ValueError(f"{one} was given as both short and long exposure; give two exposures of one scene")
    frames, pairs = {one: frames_of(one, channel=channel)[0] for one in (*short, *long)}, zip(short, longs, strict=True)
    return [ExposurePair(frames[one], frames[other], exposure_ratio, str(one), str(other)) for one, other in pairs]


def _files(given: str | Path | Sequence[str | Path]) -> list[str | Path]:
    files = [given] if isinstance(given, str | Path) else list(given)
    if not all(isinstance(one, str | Path) for one in files):
        raise TypeError("read_pairs takes the names of files; for arrays, use [ExposurePair(short, long)]")
    return files


def read_burst(
    paths: Sequence[str | Path], *, name: str | None = None, calibration: bool = False, channel: str | None = None
) -> Burst:
    """Read a burst from one stack, or from single-frame files in the order recorded.

    Args:
        paths: the files.
        name: name of the burst in messages; by default the file name, or "the burst".
        calibration: whether these are dark or flat frames.
        channel: see `frames_of`.

    Raises:
        FileNotFoundError: a file does not exist.
        ValueError: a file cannot be read, the frames differ in size, or `Burst` rejects them.

    Example:
        >>> import calibration, noiseflow, numpy as np, pathlib, tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> noiseflow.io.write(folder / "dark.tif", np.random.default_rng(0).poisson(100, (5, 32, 32)).astype(np.uint16))
        >>> calibration.read_burst([folder / "dark.tif"], calibration=True).frames.shape
        (5, 32, 32)
    """
    frames: list[NDArray[Any]] = []
    shown = ""
    for path in paths:
        data, shown = frames_of(path, channel=channel)
        frames += list(data) if data.ndim == 3 else [data]
    for frame in frames[1:]:
        require_same_size(frames[0], "the first frame", frame, "a later frame")
    return Burst(np.stack(frames), name or (shown if len(paths) == 1 else "the burst"), calibration)


def read_levels(
    paths: Sequence[str | Path], *, name: str = "the flat frames", channel: str | None = None
) -> list[Burst]:
    """Read flat frames at several light levels: each stack is one, and consecutive files of single frames with equal means."""
    levels: list[list[NDArray[Any]]] = []
    single = False
    for path in paths:
        data, _ = frames_of(path, channel=channel)
        last = levels[-1][-1] if single else np.empty(0)
        # 1 % is the flicker of typical light sources
        if data.shape == last.shape and math.isclose(data.mean(dtype=float), last.mean(dtype=float), rel_tol=0.01):
            levels[-1].append(data)
        else:
            levels.append(list(data) if data.ndim == 3 else [data])
        single = data.ndim == 2
    return [Burst(np.stack(level), f"{name}, level {i}", True) for i, level in enumerate(levels, 1)]


def cropped(exposures: Any, region: str | None) -> Any:
    """Exposures, or a list of them, within ``y0:y1,x0:x1`` of each frame. Raises ValueError if this is no region of it."""
    if region is None or isinstance(exposures, list):
        return exposures if region is None else [cropped(one, region) for one in exposures]
    names = {"frames": "name"} if isinstance(exposures, Burst) else {"short": "short_name", "long": "long_name"}
    part = parse_region(region, getattr(exposures, next(iter(names))).shape[-2:])
    changed = {name: getattr(exposures, name)[(..., *part)] for name in names}
    shown = {name: f"--region {region} of {getattr(exposures, name)}" for name in names.values()}
    return replace(exposures, **changed, **shown)
