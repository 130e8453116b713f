"""Frames, exposure pairs and bursts, in memory and in files. They are validated once, on construction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.described import described
from noiseflow.io import as_array, read, require_contrast, require_finite
from noiseflow.io.checks import is_colour, parse_region
from noiseflow.models.digitisation import Digitisation, detect_digitisation

Image = NDArray[np.float64]
_KNOWN: dict[tuple[Any, ...], Digitisation] = {}

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
        >>> short, long = np.random.default_rng(0).poisson(np.multiply.outer([10, 100], np.arange(1, 129) * np.ones((128, 1))))
        >>> calibration.ExposurePair(short, long, exposure_ratio=10.0).short.shape
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
        require_same_size(self.short, self.short_name, self.long, self.long_name)
        for frame, name in ((self.short, self.short_name), (self.long, self.long_name)):
            _require_more_than_two_values(frame, name)
        if np.array_equal(self.short, self.long):
            raise ValueError(f"{self.short_name} and {self.long_name} have identical pixels; give separate exposures")
        if self.exposure_ratio is not None and not 1 < self.exposure_ratio < np.inf:
            raise ValueError(
                f"the exposure ratio (long over short) is {self.exposure_ratio:g}, not above 1: exchange the two, or give a burst"
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
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> calibration.Burst(frames).frames.shape
        (6, 64, 64)
    """

    frames: Image
    name: str = "the burst"
    calibration: bool = False

    def __post_init__(self) -> None:
        frames = as_array(self.frames)
        if frames.ndim != 3 or len(frames) < 2:
            holds = "contain" if self.name.endswith("frames") else "contains"
            more = "at least two" if self.calibration else "a long exposure, or a burst of at least two equal exposures"
            raise ValueError(f"{self.name} {holds} only one frame (shape {frames.shape}); give {more}")
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
        if not self.calibration:
            _require_more_than_two_values(self.frames, self.name)

    def require_unsaturated(self, *, dark: bool = False) -> None:
        """Raise ValueError if a frame is constant, or over half of its pixels are saturated. Frames of few pixels are judged
        together. All that clipping, subtraction or coarse codes leave of frames that are `dark` may be one value."""
        if dark and np.ptp(self.frames) == 0:
            return
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
    if data.ndim != 2:
        raise ValueError(
            f"{name} has shape {data.shape}, but a single 2D frame is required: choose it with --channel, convert colours to "
            "grey, or give a stack alone, to read it as a burst"
        )
    if min(data.shape) < least_side:
        raise ValueError(f"{name} is {data.shape[0]}x{data.shape[1]} pixels; at least {least_side} a side are required")
    require_finite(data, name)
    if not may_saturate:
        _require_unsaturated(data, name)
    return data.astype(np.float64)


def _require_unsaturated(data: NDArray[Any], name: str) -> None:
    rail = saturation_level(data)
    saturated = float(np.mean(data >= rail))
    largest = float(np.iinfo(data.dtype).max) if data.dtype.kind in "iu" else np.inf
    if saturated > 0.5 and (saturated < 1 or rail == largest):
        raise ValueError(f"{name} is saturated: {saturated:.0%} of its pixels are {rail:g}; use a shorter exposure")
    require_contrast(data, name)


def _require_more_than_two_values(frames: Image, name: str) -> None:
    if np.isin(frames, [frames.min(), frames.max()]).all():
        raise ValueError(
            f"{name} has only the values {frames.min():g} and {frames.max():g}, as a mask or a detector that does not count "
            "beyond one photon; its noise shows no gain: give exposures in counts"
        )


def saturation_level(frame: NDArray[Any]) -> float:
    """Return the upper clipping limit of the analogue-to-digital converter, or infinity if the frame shows none."""
    return _digitisation(frame).high


def _digitisation(frame: NDArray[Any]) -> Digitisation:
    """Rounding and clipping of a frame; those of the last few frames are remembered by their sum and a sample of pixel values."""
    key = frame.shape, str(frame.dtype), frame.flat[:: frame.size // MINIMUM_SIDE**2 + 1].tobytes(), float(frame.sum())
    if key not in _KNOWN:
        _KNOWN[key] = detect_digitisation(frame)
        for old in list(_KNOWN)[:-8]:
            del _KNOWN[old]
    return _KNOWN[key]


def rounding_step(frame: Image) -> float:
    """Return the step of which all pixel values are multiples, from the smallest one: 16 if 12 bits fill the upper ones of 16,
    and 1/65535 if those were scaled to 1; 0 if they are not rounded."""
    return _digitisation(frame).step or float(np.array_equal(frame, np.round(frame)))


def blurred_step(
    frame: Image, *, fewest: int = 50, alike: float = 0.7, reach: float = 2.5, codes: int = 12, tried: int = 512
) -> float:
    """Return the mean step, near 0, of codes that were divided by a gain reference, which spreads all but 0; 0 if there is none.

    The smallest values are then near multiples of the step: the first two codes of at least `fewest` pixels have a mean
    cosine of the phase above `alike`: 0.82 of codes that differ by 10 %, or of electrons with a read noise of 0.1, and 0.64
    of those with 0.15, whose peaks are no codes; at most one third without either.
    """
    away = np.abs(frame[frame != 0])
    if len(away) <= fewest or rounding_step(frame):
        return 0.0
    least = np.partition(away, fewest)[fewest]  # odd pixels have smaller ones
    near, rate = away[away < reach * least], np.linspace(0.5, codes, tried) / least
    sample = near[:: len(near) // MINIMUM_SIDE**2 + 1]
    phase = near * rate[np.argmax(np.cos(2 * np.pi * np.outer(rate, sample)).mean(axis=1))]
    code = np.round(phase).astype(int)
    number, cosine = np.bincount(code), np.bincount(code, np.cos(2 * np.pi * phase))
    seen = np.flatnonzero(number >= fewest)[:2]
    clear = len(seen) == 2 and (cosine[seen] > alike * number[seen]).all()
    return float(near.sum() / code.sum()) if clear else 0.0


def rails(frame: Image) -> tuple[float, float]:
    """Return the lower and upper clipping limits of the converter, as detected in the frame; infinite if not detected."""
    found = _digitisation(frame)
    return (0.0 if frame.min() == 0 else found.low), found.high


def require_same_size(first: NDArray[Any], first_name: str, second: NDArray[Any], second_name: str) -> None:
    if first.shape != second.shape:
        raise ValueError(f"{first_name} {first.shape}, {second_name} {second.shape}: sizes must agree; use one binning")


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
