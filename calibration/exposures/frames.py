"""Frames, exposure pairs and bursts. They are validated once, on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.described import described
from noiseflow.io import as_array, read, require_contrast, require_finite
from noiseflow.models.digitisation import detect_digitisation

Image = NDArray[np.float64]

ALIKE = 0.8
"""Mean squared difference of successive slices along the last axis, relative to that along the first, below which the last axis
counts the frames. It is 1 for pure noise, whose axes do not matter, and above 1 for frames along the first axis."""

MINIMUM_SIDE = 32
"""Smallest frame side, in pixels, that can be registered and measured."""


@described(short="detector units", long="detector units")
@dataclass(frozen=True)
class ExposurePair:
    """A short, noisy exposure and a long, cleaner exposure of one scene.

    Args:
        short: (y, x) frame whose noise is measured, detector units; an array or a tensor.
        long: (y, x) frame that provides the signal, in any linear scale of detector units.
        exposure_ratio: ratio of the long to the short exposure time (or dose), > 1; None if unknown.
        short_name: name of the short frame in messages.
        long_name: name of the long frame in messages.

    Raises:
        ValueError: a frame is not a single grey image, is too small, has NaN or infinite pixels, is constant or saturated; the
            frames differ in size or are identical; the ratio is not above 1.

    Example:
        >>> import calibration, numpy as np
        >>> from scipy.ndimage import gaussian_filter
        >>> scene = 1000 * gaussian_filter(np.random.default_rng(0).random((128, 128)), 2)
        >>> short = np.random.default_rng(1).poisson(scene / 10)
        >>> pair = calibration.ExposurePair(short, scene, exposure_ratio=10.0)
        >>> pair.short.shape
        (128, 128)
    """

    short: Image
    long: Image
    exposure_ratio: float | None = None
    short_name: str = "the short exposure"
    long_name: str = "the long exposure"

    def __post_init__(self) -> None:
        object.__setattr__(self, "short", checked_frame(self.short, self.short_name))
        object.__setattr__(self, "long", checked_frame(self.long, self.long_name))
        _require_same_size(self.short, self.short_name, self.long, self.long_name)
        if np.array_equal(self.short, self.long):
            raise ValueError(
                f"{self.short_name} and {self.long_name} have identical pixels; "
                "give two separate exposures of one scene"
            )
        if self.exposure_ratio is not None and not 1 < self.exposure_ratio < np.inf:
            raise ValueError(
                f"the exposure ratio (long over short) is {self.exposure_ratio:g} but must be above 1: "
                "swap --short and --long, or give equal exposures as a burst"
            )


@described(frames="detector units")
@dataclass(frozen=True)
class Burst:
    """Equal exposures of one scene; each frame is compared with the mean of the others.

    Args:
        frames: (frame, y, x) in the order recorded, detector units, at least two frames; an array or a tensor.
        name: name of the burst in messages.
        calibration: dark or flat frames, which need no scene; flat frames may be saturated.

    Raises:
        ValueError: there are fewer than two frames, two frames are identical, or `checked_frame` rejects a frame.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> calibration.Burst(frames).frames.shape
        (6, 64, 64)
    """

    frames: Image
    name: str = "the burst"
    calibration: bool = False

    def __post_init__(self) -> None:
        frames = as_array(self.frames)
        if frames.ndim != 3 or len(frames) < 2:
            raise ValueError(
                f"{self.name} {_holds(self.name)} only one frame (shape {frames.shape}); to measure the noise, give "
                + (
                    "at least two"
                    if self.calibration
                    else "a long exposure with it, or a burst of at least two equal exposures"
                )
            )
        least = 1 if self.calibration else MINIMUM_SIDE
        checked = [
            checked_frame(frame, f"{self.name}, frame {i}", least_side=least, may_saturate=self.calibration)
            for i, frame in enumerate(frames)
        ]
        for i, (first, second) in enumerate(pairwise(checked)):
            # saturated frames are always equal, and a few pixels of little noise often are
            if first.size >= MINIMUM_SIDE**2 and np.ptp(first) > 0 and np.array_equal(first, second):
                raise ValueError(f"{self.name}: frames {i} and {i + 1} have identical pixels; remove the copy")
        object.__setattr__(self, "frames", np.stack(checked))

    def require_unsaturated(self) -> None:
        """Reject calibration frames whose noise is clipped.

        Raises:
            ValueError: a frame is constant, or over half of its pixels are saturated. Frames of few pixels are judged together.
        """
        if self.frames[0].size < MINIMUM_SIDE**2:
            _require_unsaturated(self.frames, self.name)
            return
        for i, frame in enumerate(self.frames):
            _require_unsaturated(frame, f"{self.name}, frame {i}")


def checked_frame(
    data: NDArray[Any], name: str, *, least_side: int = MINIMUM_SIDE, may_saturate: bool = False
) -> Image:
    """Validate one grey frame and return it as float64, (y, x).

    Args:
        data: (y, x) or (1, y, x), any real number type.
        name: name of the frame in messages.
        least_side: smallest side, pixels.
        may_saturate: accept saturated or constant frames.

    Raises:
        ValueError: the frame is not a single grey image, is smaller than `least_side`, has NaN or infinite pixels, is constant,
            or over half of its pixels are saturated.
    """
    data = as_array(data)
    if data.ndim == 3 and data.shape[0] == 1:
        data = data[0]
    if data.ndim == 3 and min(data.shape[0], data.shape[-1]) <= 4:
        raise ValueError(f"{name} is a colour image (shape {data.shape}); convert it to one grey channel first")
    if data.ndim != 2:
        raise ValueError(
            f"{name} has shape {data.shape}, but a single 2D frame is required (give a stack alone to read it as a burst)"
        )
    if min(data.shape) < least_side:
        raise ValueError(
            f"{name} is {data.shape[0]}x{data.shape[1]} pixels; at least {least_side} per side are required"
        )
    require_finite(data, name)
    if not may_saturate:
        _require_unsaturated(data, name)
    return data.astype(np.float64)


def _require_unsaturated(data: NDArray[Any], name: str) -> None:
    rail = saturation_level(data)
    saturated = float(np.mean(data >= rail))
    if saturated > 0.5 and (saturated < 1 or rail == _largest_value(data)):
        raise ValueError(
            f"{name} is saturated: {saturated:.0%} of its pixels have the value {rail:g}; use a shorter exposure"
        )
    require_contrast(data, name)


def saturation_level(frame: NDArray[Any]) -> float:
    """Return the upper clipping limit of the analogue-to-digital converter, or infinity if the frame shows none.

    Args:
        frame: any shape, detector units.
    """
    return detect_digitisation(frame).high


def rounding_step(frame: Image) -> float:
    """Return 1 if all pixel values are whole numbers, else 0 (not rounded)."""
    return 1.0 if np.array_equal(frame, np.round(frame)) else 0.0


def rails(frame: Image) -> tuple[float, float]:
    """Return the lower and upper clipping limits of the converter, as detected in the frame; infinite if not detected."""
    found = detect_digitisation(frame)
    return (0.0 if frame.min() == 0 else found.low), found.high


def _largest_value(data: NDArray[Any]) -> float:
    return float(np.iinfo(data.dtype).max) if data.dtype.kind in "iu" else float("inf")


def frames_of(path: str | Path, *, channel: str | None = None) -> tuple[NDArray[Any], str]:
    """Read the frames of a file, and return them with the file's name for messages.

    Arrays whose last axis counts the frames, as in MATLAB, are recognised: successive frames of one scene differ less than
    neighbouring pixels.

    Args:
        path: the file.
        channel: name or index of one channel or image, if the file holds several.

    Returns:
        (frame, y, x) or (y, x) array, and the name.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file cannot be read, is in colour, or holds several images of which none was chosen.
    """
    data, name = read(path, channel=channel).data, str(path)
    if data.ndim == 3 and data.shape[-1] in (3, 4) and data.shape[0] > 4:
        raise ValueError(f"{path} is a colour image (shape {data.shape}); convert it to one grey channel first")
    if data.ndim == 3 and 1 < data.shape[2] < min(data.shape[:2]):
        first, last = (float(np.mean(np.square(np.diff(data.astype(np.float64), axis=axis)))) for axis in (0, 2))
        if last < ALIKE * first:
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
        raise ValueError(
            f"{len(short)} short and {len(long)} long exposures were given; "
            "give one long exposure per short exposure, or one for all"
        )
    longs = list(long) * (len(short) if len(long) == 1 else 1)
    for one, other in zip(short, longs, strict=True):
        if Path(one).resolve() == Path(other).resolve():
            raise ValueError(
                f"{one} was given as both short and long exposure; give two separate exposures of one scene"
            )
    return [
        ExposurePair(
            frames_of(one, channel=channel)[0],
            frames_of(other, channel=channel)[0],
            exposure_ratio,
            str(one),
            str(other),
        )
        for one, other in zip(short, longs, strict=True)
    ]


def _files(given: str | Path | Sequence[str | Path]) -> list[str | Path]:
    """One file or several as a list."""
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
        _require_same_size(frames[0], "the first frame", frame, "a later frame")
    return Burst(np.stack(frames), name or (shown if len(paths) == 1 else "the burst"), calibration)


def _holds(name: str) -> str:
    """Return the verb for a name such as "the burst" or "the dark frames"."""
    return "contain" if name.endswith("frames") else "contains"


def read_levels(
    paths: Sequence[str | Path], *, name: str = "the flat frames", channel: str | None = None
) -> list[Burst]:
    """Read flat frames at several light levels.

    Each stack is one level. Consecutive single-frame files with equal means also form one level.

    Args:
        paths: the files.
        name: name of the frames in messages.
        channel: see `frames_of`.

    Raises:
        FileNotFoundError: a file does not exist.
        ValueError: a file cannot be read, or a level has only one frame.
    """
    levels: list[list[NDArray[Any]]] = []
    single = False
    for path in paths:
        data, _ = frames_of(path, channel=channel)
        frames = list(data) if data.ndim == 3 else [data]
        equal = levels and single and len(frames) == 1 and _equal_light(levels[-1][-1], frames[0])
        if equal:
            levels[-1] += frames
        else:
            levels.append(frames)
        single = len(frames) == 1
    return [Burst(np.stack(level), f"{name}, level {i}", True) for i, level in enumerate(levels, 1)]


def _equal_light(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Test whether two frames belong to one level: their means differ by less than 1 %, the flicker of typical light sources."""
    if first.shape != second.shape:
        return False
    one, other = float(np.mean(first, dtype=float)), float(np.mean(second, dtype=float))
    return abs(one - other) < 0.01 * abs(one + other) / 2


def _require_same_size(first: NDArray[Any], first_name: str, second: NDArray[Any], second_name: str) -> None:
    if first.shape != second.shape:
        raise ValueError(
            f"{first_name} is {first.shape} and {second_name} is {second.shape} pixels; the sizes must be equal: "
            "record both with the same binning and region"
        )
