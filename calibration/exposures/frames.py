"""Frames, exposure pairs and bursts. They are validated once, on construction."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.described import described
from noiseflow.io import as_array, require_contrast, require_finite
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
