"""Starting points for the maximum-likelihood fit of shot plus read noise, which has many maxima if electrons are resolved."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from noiseflow.distributions.electrons.exact import log_density
from noiseflow.fitting.cells import Cells, count, gather
from noiseflow.fitting.steps import lbfgs
from noiseflow.models.standardisation import Standardisation
from noiseflow.statistics import SAMPLE, weighted_line

# Electrons: peaks of this width change the density by 0.2 %; narrower ones can be seen in means of pixels where there are none.
# At two thirds of it, the likelihood hardly depends on a shift by an electron.
_SHARP = 0.6


class DetectorStart(NamedTuple):
    """Gain (counts per electron), offset (counts) and read noise (electrons)."""

    gain: float
    offset: float
    read_noise: float


def find_detector(
    signal: Tensor, observation: Tensor, *, scored: int = 512, climbed: int = 2048, climbs: int = 6
) -> tuple[DetectorStart, Tensor]:
    """Maximum-likelihood detector for (N,) signals and observations, from the best of many starting points, and its `_axes`.

    Starting points come from a straight line of variance against signal and, if electrons are resolved, from the strongest
    frequencies of the pixel values, which give spacing, phase and sharpness of the peaks. They are scored on few pixels; from the
    best, the likelihood of more is climbed: after three climbs, one of 60 detectors was 0.005 nats below the truth.

    Raises:
        ValueError: the observations equal the signals.
    """
    signal, observation = _sorted(*_spread_rounded(signal.double().cpu(), observation.double().cpu()))
    variance = float((observation - signal).square().mean())
    if not variance > 0:
        raise ValueError("observation − signal is 0 everywhere: there is no noise to fit; check that the images differ")
    slope = _slope(signal, observation)
    mean, low, spread = float(signal.mean()), float(signal.min()), math.sqrt(variance)
    smooth = [(gain, low - far * spread) for gain in (slope, 0.3 * spread) for far in (0, 1, 4)]
    noises = [math.sqrt(max(variance / gain - mean + offset, 0) / gain) for gain, offset in smooth]
    comb = _comb_starts(signal, observation, variance, slope)
    pixels = _even(signal, observation, climbed) if comb else _alike(signal, observation)
    least = 0.0 if comb else _SHARP
    few = _even(signal, observation, scored)
    starts = [
        start._replace(read_noise=max(start.read_noise, 0.1, 2 * least))
        for start in [*map(DetectorStart, *zip(*smooth, strict=True), noises), *comb]
    ]
    ranked = sorted(starts, key=lambda start: -_score(start, few))
    found = [_climb(start, pixels, least) for start in ranked[:climbs]]
    best = max(found, key=lambda each: _score(each, pixels))
    return best, _axes(best, few)


def _axes(detector: DetectorStart, pixels: Cells, *, flattest: float = 0.04) -> Tensor:
    """(3, 3) steps of (log gain, offset, log read noise), in columns; each changes the likelihood by about half a nat per pixel.
    This is the inverse square root of the curvature of the likelihood; flat directions get a step of five natural units."""
    with torch.enable_grad():
        loss = lambda change: -_log_prob(pixels, _changed(detector, change, 0))  # noqa: E731
        curvature = torch.autograd.functional.hessian(loss, torch.zeros(3, dtype=torch.float64))  # type: ignore[no-untyped-call]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(curvature))
    units = torch.tensor([[1.0], [detector.gain * detector.read_noise], [1.0]], dtype=torch.float64)
    axes: Tensor = units * ((vectors / values.abs().clamp(min=flattest).sqrt()) @ vectors.T)
    return axes


def _changed(start: DetectorStart, change: Tensor, least: float) -> tuple[Tensor, Tensor, Tensor]:
    read_noise = least + (start.read_noise - least) * torch.exp(change[2])
    offset = start.offset + start.gain * start.read_noise * change[1]
    return start.gain * torch.exp(change[0]), offset, read_noise.clamp(min=1e-2)


def _sorted(signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    order = torch.argsort(signal, stable=True)
    return signal[order], observation[order]


def _even(signal: Tensor, observation: Tensor, count: int) -> Cells:
    """About `count` of the `_sorted` pixels, which cover the range of signals."""
    few, values = (each[:: max(1, signal.numel() // count)] for each in (signal, observation))
    return Cells(few, values, torch.full_like(few, 1 / few.numel(), dtype=torch.float64))


def _spread_rounded(signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Spread pixel values that repeat over their cells; otherwise a density could become unbounded at the levels, and the steps
    of half precision be taken for electrons. Steps may grow with the values, and gaps hold levels that no pixel has."""
    levels, place = torch.unique(observation, return_inverse=True)
    if levels.numel() in (1, observation.numel()):
        return signal, observation
    step = -torch.nn.functional.max_pool1d(-torch.diff(levels)[None], 9, stride=1, padding=4)[0]  # the least near by
    generator = torch.Generator().manual_seed(0)
    shift = torch.rand(observation.shape, generator=generator, dtype=torch.float64) - 0.5
    return signal, observation + step[place.clamp(max=len(step) - 1)] * shift


def _slope(signal: Tensor, observation: Tensor, *, levels: int = 32) -> float:
    """Slope of the variance against `_sorted` signals, by weighted least squares; from 1e-3 to 10 standard deviations."""
    parts = [torch.tensor_split(each, min(levels, signal.numel())) for each in (signal, observation - signal)]
    mean, variance = np.array([[float(s.mean()), float(r.square().mean())] for s, r in zip(*parts, strict=True)]).T
    slope = weighted_line(mean, variance, np.maximum(variance, 1e-3 * variance.mean()) ** -2.0).slope
    return float(np.clip(slope, *(math.sqrt(variance.mean()) * np.array([1e-3, 10]))))


def _comb_starts(
    signal: Tensor, observation: Tensor, variance: float, slope: float, *, cells: int = 40, widest: int = 10_000
) -> list[DetectorStart]:
    """Detectors whose electron peaks match the strongest frequencies of the pixel values near one per gain; none if no electrons
    are resolved. The gain is near `slope`, unless signals are too similar to know. The histogram has so many cells per
    electron; of the `widest`, in electrons, the transform takes seconds."""
    readings = _even(signal, observation, 2**18).values
    reach = float(torch.quantile(readings, 0.995) - torch.quantile(readings, 0.005))
    known = slope * float(signal.std()) > 5 * variance * math.sqrt(2 / signal.numel())  # errors of the variance
    low, high = (0.6 * slope, 1.7 * slope) if known else (0.01 * math.sqrt(variance), 2 * math.sqrt(variance))
    if not 0 < reach < widest * low:
        return []
    # the mean of exp(2πi·frequency·(reading − mean)), from a fine histogram
    cell = torch.round((readings - readings.mean()) / (width := low / cells)).long()
    size = 2 ** max(1, math.ceil(math.log2(5 * reach / width)))
    wave = torch.fft.rfft(torch.bincount(cell % size, minlength=size).double()).conj() / readings.numel()
    height = torch.nn.functional.pad(wave.abs(), (1, 1))
    crest = (height[1:-1] >= height[:-2]) & (height[1:-1] >= height[2:])
    crest &= wave.abs() > 5 / math.sqrt(readings.numel())
    crest[: math.ceil(size * width / high)], crest[size // cells + 1 :] = False, False
    starts = []
    for index in sorted(torch.nonzero(crest).flatten().tolist(), key=lambda i: -float(wave[i].abs()))[:4]:
        gain = size * width / index
        read_noise = math.sqrt(max(-2 * math.log(float(wave[index].abs())), 0.01)) / (2 * math.pi)
        phase = float(readings.mean()) + gain * float(wave[index].angle()) / (2 * math.pi)
        nearest = round((float(signal.mean()) - variance / gain + gain * read_noise**2 - phase) / gain)
        starts += [DetectorStart(gain, phase + gain * (nearest + step), read_noise) for step in range(-4, 5)]
    return starts


def settle(detector: Any, noise_model: Any, signal: Tensor, observation: Tensor) -> None:
    """Maximise the likelihood of (N,) pixels under `noise_model` over ``detector.change``; the detector is part of that model. A
    maximum found with few pixels may be off by some electrons, if these are resolved. The offset of a detector with `axes`
    therefore moves by one electron at a time, up or down, as long as all pixels gain more than half a nat together, which
    is chance."""
    change, lowest, counted = detector.change, float(signal.min()), count(signal, observation)
    learns, smooth = change.requires_grad, counted is None and _sharpness(detector, lowest) > _SHARP
    raw = counted or _even(*_sorted(signal, observation), SAMPLE)
    pixels = _alike(signal, observation, noise_model.low, noise_model.high) if smooth else raw
    least = _SHARP if smooth and hasattr(detector, "axes") else 0.0

    def loss() -> Tensor:
        if not _usable(detector.gain, detector.offset, detector.read_noise) or _sharpness(detector, lowest) < least:
            return _too_far(change)
        log_prob: Tensor = noise_model(pixels.signal).log_prob(pixels.values)
        return -torch.dot(log_prob.double(), pixels.weight.double())

    change.requires_grad_(True)
    best, kept = _settled(change, change.detach().clone(), loss), change.detach().clone()
    if smooth and _sharpness(detector, lowest) < 1.1 * _SHARP:  # held back, or the noise is sharper than it seemed
        pixels, least = raw, 0.0
        best, kept = _settled(change, kept, loss), change.detach().clone()
    if hasattr(detector, "axes") and _sharpness(detector, lowest) < _SHARP / 1.5:
        along_offset = torch.linalg.solve(detector.axes.double().cpu(), torch.eye(3, dtype=torch.float64)[1])
        step = float(detector.gain.detach()) * along_offset.to(change)
        for side in (-1, 1):
            while (found := _settled(change, kept + side * step, loss)) < best - 0.5 / signal.numel():
                best, kept = found, change.detach().clone()
    change.data.copy_(kept)
    change.requires_grad_(learns)


def _sharpness(detector: Any, lowest: float) -> float:
    """Standard deviation of the narrowest peaks of the noise, electrons. Random multiplication widens all but that of none,
    which matters below seven electrons."""
    gain, offset, read_noise, *excess = (float(each.detach()) for each in detector._parameters_now())
    least = max(lowest - offset - 7 * gain, 0.0) / gain
    return math.hypot(read_noise, math.sqrt(least * sum(excess)))


def _alike(signal: Tensor, observation: Tensor, low: float = -math.inf, high: float = math.inf) -> Cells:
    """Means of alike pixels and their weights, which lose nothing if the noise is smooth between its limits."""
    scale = Standardisation().to(signal.device)
    scale.set_from(signal, observation)
    return gather(scale, signal, observation, low=low, high=high, along=128)


def _settled(change: Tensor, start: Tensor, loss: Callable[[], Tensor], *, num_steps: int = 48) -> float:
    """Minimise the loss from `start`, in place. Return the final loss, never above the initial one. Of 60 detectors, 24
    iterations left 0.00006 nats in one; converged searches stop by themselves."""
    change.data.copy_(start)
    first = float(loss().detach())
    optimiser = lbfgs([change], max_iter=num_steps)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss()
        value.backward()  # type: ignore[no-untyped-call]
        return value.detach()

    with torch.enable_grad():
        optimiser.step(closure)  # type: ignore[no-untyped-call]
    change.grad, last = None, float(loss().detach())
    if last <= first:
        return last
    change.data.copy_(start)
    return first if math.isfinite(first) else math.inf


def _log_prob(pixels: Cells, detector: Sequence[Tensor]) -> Tensor:
    (signal, observation, weight), (gain, offset, read_noise) = pixels, detector
    rate = (signal - offset).clamp(min=0) / gain
    return torch.dot(log_density((observation - signal) / gain, rate, read_noise), weight) - torch.log(gain)


@torch.no_grad()
def _score(detector: DetectorStart, pixels: Cells) -> float:
    found = float(_log_prob(pixels, [torch.tensor(each, dtype=torch.float64) for each in detector]))
    return found if math.isfinite(found) else -math.inf


def _climb(start: DetectorStart, pixels: Cells, least: float) -> DetectorStart:
    """Maximum likelihood by a quasi-Newton method from one starting point, at no less than some read noise."""
    change = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def loss() -> Tensor:
        detector = _changed(start, change, least)
        return -_log_prob(pixels, detector) if _usable(*detector) else _too_far(change)

    _settled(change, change.detach().clone(), loss)
    return DetectorStart(*(float(each.detach()) for each in _changed(start, change, least)))


def _usable(gain: Tensor, *others: Tensor) -> bool:
    """Whether the gain is positive, and the numbers of a detector are far from overflow: densities need their squares."""
    return bool(torch.stack([gain, gain.rsqrt(), *others]).detach().double().pow(4).isfinite().all())


def _too_far(change: Tensor) -> Tensor:
    """The loss after a step so far that exponentials are 0 or infinite, which is not taken."""
    return math.inf + 0.0 * torch.nan_to_num(change).sum()
