"""The methods on a real tilt series, evaluated on held-out tilts: as measured, and with added noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import noiseflow
from benchmarks.scenes import Cell, Results
from benchmarks.search import STEPS, Array, Best, back_projections, best, best_fit, denoised, sirts
from noiseflow import Gaussian, SignalDependentGaussian, fit
from recon.fields.fields import find_field
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers.second_order import TotalVariation
from recon.joint.joint import JointReconstructor
from recon.methods.joint import Laplace
from recon.metrics.comparison import project
from recon.series.files import read_tilt_series
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.noises import CountingNoise

NOISES = {"as measured": None, "10 counts": 10.0}
"""Noise added to the real images, by name: mean counts in the brightest pixel, or none."""

GAPS: dict[str, Callable[[Array], Array]] = {
    "every fifth": lambda angles: np.arange(len(angles)) % 5 == 2,
    "beyond 60°": lambda angles: abs(angles) > 60,
}
"""Held-out tilts, by name."""

_READ_NOISE = 0.5
_ROUNDS = 2


@dataclass(frozen=True)
class Split:
    """A tilt series split into reconstruction and held-out tilts.

    Attributes:
        given: tilts for the reconstruction.
        left_out: held-out tilts, with the same noise.
        target: the held-out tilts as measured, in the units of `left_out`.
    """

    given: TiltSeries
    left_out: TiltSeries
    target: Array


def load() -> TiltSeries:
    """The needle series of the example data."""
    data = Path(noiseflow.__file__).parent / "data" / "tilt_needle"
    return read_tilt_series(data / "needle_aligned.mrc", mode="linear")


def split(series: TiltSeries, noise: str, gap: str, *, seed: int) -> Split:
    """Add noise and hold out tilts, both by name; counts are in detector units."""
    images = np.asarray(series.images, dtype=np.float32)
    counts = NOISES[noise]
    target = images if counts is None else images * np.float32(counts / images.max())
    noisy = target
    if counts is not None:
        drawn = CountingNoise(_READ_NOISE, most=int(counts + 12 * counts**0.5))(torch.from_numpy(target))
        noisy = drawn.sample(generator=torch.Generator().manual_seed(seed)).numpy()
    out = GAPS[gap](series.tilt_angles)
    whole = replace(series, images=noisy)
    return Split(whole.select(~out), whole.select(out), target[out])


def methods(given: TiltSeries, score: Callable[[Array], float]) -> dict[str, Callable[[], Best]]:
    """Functions that compute the best volume of each method by `score`; joint fits use their own selection and come last."""
    grid = VolumeGrid.of(given)
    least_squares = JointReconstructor(noise_model=Gaussian, num_steps=STEPS, regulariser=TotalVariation())
    absolute = replace(least_squares, noise_model=Laplace)
    voxels = replace(least_squares, make_field=VoxelField)

    def once(reconstructor: JointReconstructor, words: str) -> Best:
        result = reconstructor(given, grid)
        return Best(f"{words}weight {result.weight:.3g}", result.volume.attenuation, {})

    return {
        "WBP": lambda: best(back_projections(given, grid), score),
        "SIRT": lambda: best(sirts(given, grid), score),
        "WBP, denoised (nlm)": lambda: best(back_projections(denoised(given, "nlm"), grid), score),
        "L2, voxels, no TV": lambda: once(replace(voxels, weight=0.0), ""),
        "L2 + TV, voxels": lambda: best_fit(given, grid, voxels, score),
        "L2 + TV": lambda: best_fit(given, grid, least_squares, score),
        "L1 + TV": lambda: best_fit(given, grid, absolute, score),
        "L2 + TV, denoised (nlm)": lambda: best_fit(denoised(given, "nlm"), grid, least_squares, score),
        "joint, voxels": lambda: once(JointReconstructor(make_field=VoxelField), "chose "),
        "joint, Gaussians": lambda: once(JointReconstructor(make_field=find_field("gaussians")), "chose "),
        "joint, network": lambda: once(JointReconstructor(make_field=find_field("network")), "chose "),
        f"joint, {STEPS} steps": lambda: once(JointReconstructor(num_steps=STEPS), "chose "),
        "joint": lambda: once(JointReconstructor(), "chose "),
    }


def run(results: Results, line: Callable[[str], None], *, quick: bool, seed: int) -> None:
    """Compute the result of each noise, gap and method; existing results are kept."""
    series = load()
    for noise in list(NOISES)[1:] if quick else NOISES:
        for gap in list(GAPS)[:1] if quick else GAPS:
            parts = split(series, noise, gap, seed=seed)
            line(f"needle, {noise}, tilts left out: {gap}; {parts.given.num_tilts} tilts given")
            for name, make in methods(parts.given, partial(psnr_of, parts)).items():
                if quick and "TV" in name:
                    continue
                cell = results.cell(f"{noise}/{gap}/{name}", lambda p=parts, m=make: judged(p, m()))  # type: ignore[misc]
                line(f"  {name}: {cell['psnr']:.2f} dB, {cell['nll']:.4f} nats per pixel ({cell['setting']})")


def judged(parts: Split, found: Best) -> Cell:
    angles = parts.left_out.tilt_angles
    return {
        "setting": found.setting,
        "tried": found.tried,
        "at an end": found.at_an_end,
        "psnr": psnr_of(parts, found.volume),
        "nll": held_out_nll(predict(parts.given, found.volume, angles, likely=True), parts.left_out.images),
    }


def psnr_of(parts: Split, volume: Array) -> float:
    """PSNR of the held-out tilts, dB."""
    predicted = predict(parts.given, volume, parts.left_out.tilt_angles)
    span = float(parts.target.max() - parts.target.min())
    return -10 * float(np.log10(np.mean((predicted - parts.target) ** 2) / span**2))


def predict(given: TiltSeries, volume: Array, angles: Array, *, likely: bool = False) -> Array:
    """Predict images at other angles: projections with a common gain and offset fitted to the given tilts.

    Args:
        given: the tilts the volume was reconstructed from.
        volume: (z, y, x).
        angles: degrees.
        likely: fit gain and offset by maximum likelihood under signal-dependent noise (iteratively reweighted least squares)
            instead of ordinary least squares, in which vacuum has little weight.
    """
    own, images = project(volume, given.tilt_angles, mode=given.mode).ravel(), given.images.ravel()
    gain, offset = np.polyfit(own.astype(np.float64), images.astype(np.float64), 1)
    for _ in range(_ROUNDS if likely else 0):
        signal = torch.from_numpy((own * gain + offset).astype(np.float32))
        model = _noise_of(signal, torch.from_numpy(images.astype(np.float32)))
        with torch.no_grad():
            width = model(signal).stddev.double().numpy()
        gain, offset = np.polyfit(own.astype(np.float64), images.astype(np.float64), 1, w=1 / width)
    return np.asarray(project(volume, angles, mode=given.mode) * gain + offset, dtype=np.float32)


def held_out_nll(predicted: Array, observed: Array) -> float:
    """Nats per pixel of the held-out tilts, under a signal-dependent Gaussian fitted to the other half of their pixels."""
    signals, readings = (torch.from_numpy(np.asarray(array, dtype=np.float32)) for array in (predicted, observed))
    found = []
    for first in (0, 1):
        model = _noise_of(signals[first::2], readings[first::2])
        with torch.no_grad():
            found.append(-model(signals[1 - first :: 2]).log_prob(readings[1 - first :: 2]).double().mean())
    return float(sum(found) / 2)


def _noise_of(signals: Tensor, readings: Tensor) -> SignalDependentGaussian:
    model = SignalDependentGaussian()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        fit(model, signals, readings, digitise=False, num_steps=200, generator=torch.Generator().manual_seed(0))
    return model


def table(cells: dict[str, Cell]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows for all noises and gaps, best PSNR first."""
    header = ("noise", "left out", "method", "PSNR (dB)", "NLL (nats per pixel)", "best setting")
    keys = [(noise, gap) for noise in NOISES for gap in GAPS]
    rows: list[tuple[str, ...]] = []
    for noise, gap in keys:
        found = [(key.split("/")[2], cell) for key, cell in cells.items() if key.startswith(f"{noise}/{gap}/")]
        for name, cell in sorted(found, key=lambda pair: -pair[1]["psnr"]):
            rows.append((noise, gap, name, f"{cell['psnr']:.2f}", f"{cell['nll']:.4f}", str(cell["setting"])))
    return header, rows
