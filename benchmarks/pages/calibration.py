"""Accuracy of the calibration: `python -m benchmarks.pages.calibration [registration|parameters|multiplied|real|page]`.

Each part prints its figures and stores them in ``results/calibration.json`` in docs/benchmarks; `page` writes calibration.md
from these.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, stats

from benchmarks.pages import FOLDER

Image = NDArray[np.float64]
Trial = Callable[[int], dict[str, Any]]
RESULTS = FOLDER / "results" / "calibration.json"
ROWS = RESULTS.with_name("calibration_rows")
RATIO = 16.0
NUM_TRIALS = {"registration": 400, "parameters": 300}
FIRST_SEED = {"registration": 20_000, "parameters": 0}


def textured(generator: np.random.Generator, size: int) -> Any:
    """A random field with detail from 2 to 20 pixels, mean 0 and standard deviation 1, at every real position."""
    pad = size // 3
    shape = (size + 2 * pad,) * 2
    field = sum(ndimage.gaussian_filter(generator.standard_normal(shape), blur) * blur for blur in (2.0, 6.0, 20.0))
    coefficients = ndimage.spline_filter((field - field.mean()) / field.std(), 5)
    return lambda x, y: ndimage.map_coordinates(coefficients, [y + pad, x + pad], order=5, prefilter=False)


def sparse(generator: np.random.Generator, size: int) -> Any:
    """12 to 39 round particles of height 1 and radius 3 to 8 pixels on a flat support."""
    centres = generator.uniform(0.05 * size, 0.95 * size, (generator.integers(12, 40), 2))
    radii = generator.uniform(3, 8, len(centres))
    return lambda x, y: sum(
        0.5 - 0.5 * np.tanh(np.hypot(x - cx, y - cy) - radius) for (cx, cy), radius in zip(centres, radii, strict=True)
    )


def registration_trial(kind: str, seed: int, size: int = 256) -> dict[str, Any]:
    """One pair of known transform: rotation up to 3°, shifts up to 10 %, SNR 2 to 5 in the short exposure."""
    from calibration import register

    generator = np.random.default_rng(seed)
    scene = {"textured": textured, "sparse": sparse}[kind](generator, size)
    snr, angle = generator.uniform(2, 5), np.radians(generator.uniform(-3, 3))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.full(2, (size - 1) / 2)
    matrix = np.column_stack([turn, centre - turn @ centre + generator.uniform(-0.1, 0.1, 2) * size])
    y, x = np.mgrid[:size, :size].astype(float)
    moved = np.einsum("ij,jkl->ikl", matrix[:, :2], np.stack([x, y])) + matrix[:, 2][:, None, None]
    short = scene(*moved) + generator.standard_normal(x.shape) / snr
    long = RATIO * scene(x, y) + np.sqrt(RATIO) * generator.standard_normal(x.shape) / snr
    try:
        found = register(100 + 20 * short, 300 + 20 * long)
    except ValueError:
        return {"seed": seed, "snr": snr, "found": False}
    difference = np.einsum("ij,jkl->ikl", (found.matrix - matrix)[:, :2], np.stack([x, y]))
    difference += (found.matrix - matrix)[:, 2][:, None, None]
    error = float(np.sqrt((difference**2).sum(0).mean()))
    figures = {"error": error, "predicted": found.error_px, "method": found.method}
    return {"seed": seed, "snr": snr, "found": True} | figures


def run(trial: Trial, seeds: range, workers: int, minutes: float, rows: Path) -> list[dict[str, Any]]:
    """Results of the trials of some seeds, as many as end in time, and of all that are kept from before.

    Each is kept as a line of the file `rows`, so that interrupted runs resume.
    """
    rows.parent.mkdir(parents=True, exist_ok=True)
    found = [json.loads(line) for line in rows.read_text().splitlines()] if rows.exists() else []
    left = sorted(set(seeds) - {one["seed"] for one in found}) if minutes > 0 else []
    deadline = time.perf_counter() + 60 * minutes
    with rows.open("a") as file:
        for one in _results(trial, left, workers):
            found.append(one)
            file.write(json.dumps(one) + "\n")
            file.flush()
            print(f"\r{len(found)} trials", end="", file=sys.stderr, flush=True)
            if time.perf_counter() > deadline:
                break
    return sorted(found, key=lambda one: int(one["seed"]))


def _results(trial: Trial, seeds: list[int], workers: int) -> Iterator[dict[str, Any]]:
    """Results as they come; a pool of processes is opened only for several: one that ends as it starts can hang."""
    if min(workers, len(seeds)) < 2:
        yield from map(trial, seeds)
        return
    with Pool(workers) as pool:
        yield from pool.imap_unordered(trial, seeds)


def registration(seeds: range, workers: int, minutes: float, rows: Path) -> dict[str, Any]:
    """Error against the known transform, success rate, and failures that no message reported."""
    results = {}
    for kind, limit in (("textured", 0.1), ("sparse", 0.3)):
        found = run(partial(registration_trial, kind), seeds, workers, minutes / 2, rows / f"{kind}.jsonl")
        trials = len(found)
        errors = np.array([one["error"] for one in found if one["found"]])
        predicted = np.array([one["predicted"] for one in found if one["found"]])
        results[kind] = {
            "trials": trials,
            "limit_px": limit,
            "rms_error_px": float(np.sqrt(np.mean(errors**2))),
            "median_error_px": float(np.median(errors)),
            "largest_error_px": float(errors.max()),
            "predicted_rms_px": float(np.sqrt(np.mean(predicted**2))),
            "success": float(np.mean(errors <= limit) * len(errors) / trials),
            "detected_failures": trials - len(errors),
            "silent_failures": int(np.sum(errors > limit)),
            "by_sift": float(np.mean([one["method"] == "sift" for one in found if one["found"]])),
        }
    return results


def parameter_trial(seed: int, size: int = 384) -> dict[str, Any]:
    """One simulated Poisson-Gaussian pair of random parameters, already registered, with ratio 16."""
    from calibration import ExposurePair, measure_detector
    from calibration.registration.align import Registration
    from calibration.registration.aligned import align_pair

    generator = np.random.default_rng(seed)
    gain, read_noise, electrons = (
        float(np.exp(generator.uniform(np.log(low), np.log(high)))) for low, high in ((0.5, 20), (0.2, 10), (1, 500))
    )
    clipped = bool(generator.random() < 0.5)
    offset = 0.0 if clipped else 100.0
    dose = np.exp(0.8 * textured(generator, size)(*np.mgrid[:size, :size][::-1].astype(float)))
    dose *= electrons / dose.mean()
    top = offset + gain * (dose.max() + 6 * np.sqrt(dose.max() + read_noise**2))
    allowed = [bits for bits in (8, 10, 12, 14, 16) if 2**bits - 1 > top] or [16]
    bits = int(generator.choice(allowed))

    def reading(rate: Image, rail: float) -> Image:
        electrons_read = generator.poisson(rate) + read_noise * generator.standard_normal(rate.shape)
        return np.clip(np.round(offset + gain * electrons_read), 0, rail)

    pair = ExposurePair(reading(dose, 2**bits - 1), reading(RATIO * dose, np.inf), RATIO)
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    truth = {"gain": gain, "read_noise": read_noise, "offset": offset}
    setting = truth | {"electrons": electrons, "clipped": clipped, "bits": bits, "seed": seed}
    try:
        detector = measure_detector([align_pair(pair, still)], seed=seed)
    except ValueError as error:
        return setting | {"failed": str(error)}
    found = {f"{name}_found": vars(getattr(detector.posterior, name)) for name in truth}
    return setting | found | {"misfit": detector.misfit}


def parameters(seeds: range, workers: int, minutes: float, rows: Path) -> dict[str, Any]:
    """Errors and coverage of the 90 % interval over random draws from the grid's ranges."""
    found = run(parameter_trial, seeds, workers, minutes, rows / "parameters.jsonl")
    good = [one for one in found if "failed" not in one]
    results: dict[str, Any] = {"trials": len(found), "failed": [one for one in found if "failed" in one]}
    for name in ("gain", "read_noise", "offset"):
        truth, median, low, high = (
            np.array(column)
            for column in zip(
                *((one[name], *(one[f"{name}_found"][key] for key in ("median", "q05", "q95"))) for one in good),
                strict=True,
            )
        )
        inside = (low <= truth) & (truth <= high)
        results[name] = {"coverage_90": float(inside.mean())}
        for part, chosen in (("clipped", True), ("unclipped", False)):
            mask = np.array([one["clipped"] for one in good]) == chosen
            results[name][f"coverage_90_{part}"] = float(inside[mask].mean()) if mask.any() else None
        if name != "offset":
            error = np.abs(median / truth - 1)
            identifiable = high / low < 1.5
            results[name] |= {
                "median_error": float(np.median(error)),
                "identifiable": float(identifiable.mean()),
                "median_error_identifiable": float(np.median(error[identifiable])),
            }
    return results


def multiplied(frames: int = 5000) -> dict[str, Any]:
    """Flats of 3 by 3 pixels of an EMCCD, with and without multiplication: parameters, and samples beside new frames."""
    from calibration import Burst
    from calibration.camera import calibrate_camera
    from tests.calibration.simulators import multiplied as through_register

    generator, per_count, read = np.random.default_rng(0), 5.0, 8.0
    response = 1 + 0.03 * generator.standard_normal((3, 3))

    def taken(level: float, factor: int) -> Image:
        electrons = np.broadcast_to(level * response, (frames, 3, 3))
        if factor > 1:
            return through_register(generator, electrons, gain=factor / per_count, offset=500, read=read / per_count)
        charge = generator.poisson(electrons) + read * generator.standard_normal(electrons.shape)
        return np.round(500 + charge / per_count)

    found: dict[str, Any] = {"frames": frames}
    for factor, excess, levels in ((1, 1, (50, 150, 400, 1000, 2000, 4000)), (100, 2, (2, 5, 12, 30, 70, 150))):
        flats = [Burst(taken(level, factor), calibration=True) for level in levels]
        measured = calibrate_camera(flats, [Burst(taken(0, factor), calibration=True)])
        tails = []
        for level in levels:
            real = taken(level, factor)
            drawn = measured.model(torch.full((frames, 3, 3), float(real.mean()))).sample().numpy()
            tails.append({"level": level, "real": _shape(real), "sampled": _shape(drawn)})
        found[f"{factor}×"] = {
            "truth": {"gain": excess * factor / per_count, "excess_factor": excess},
            "gain": vars(measured.figures.gain),
            "excess_factor": measured.figures.excess_factor and vars(measured.figures.excess_factor),
            "verdict": measured.verdict.grade,
            "reasons": [one.reason for one in measured.verdict.findings],
            "tails": tails,
        }
    return found


def _shape(frames: Image) -> dict[str, float]:
    """Skewness, and the 99.9 % quantile, of the distances from each pixel's mean."""
    noise = (frames - frames.mean(0)).ravel()
    return {"skewness": float(stats.skew(noise)), "quantile": float(np.quantile(noise, 0.999))}


def real(data: Path | None) -> dict[str, Any]:
    """Real detectors, measured as `noiseflow calibrate` does, beside the published maps of the same pixels."""
    from calibration import Burst, read_pairs
    from calibration.pipeline import measure_exposures
    from noiseflow.io import read

    if data is None:
        raise SystemExit("give --data: the folder that holds exposures_miro/ and detector_zhuang/")
    results: dict[str, Any] = {}
    folder = data / "exposures_miro"
    results["miro_maps"] = published(folder)
    for channel in (1, 2, 3):
        shorts = [folder / f"channel{channel}_{time_ms}ms.tif" for time_ms in ("010", "020", "050", "100")]
        found = measure_exposures(read_pairs(shorts, [folder / f"channel{channel}_long.tif"]))
        measured = {name: getattr(found.figures, name) for name in ("gain", "offset", "read_noise")}
        results[f"miro_channel{channel}"] = {
            **{name: interval and vars(interval) for name, interval in measured.items()},
            "verdict": found.verdict.grade,
            "reasons": [one.reason for one in found.verdict.findings],
        }
    folder = data / "detector_zhuang"
    frames = np.asarray(read(folder / "frames.tif").data, float)
    results["zhuang_maps"] = published(folder)
    try:
        measure_exposures(Burst(frames, "frames.tif"))
    except ValueError as error:
        results["zhuang_burst"] = {"refused": str(error)}
    results["zhuang_predicted"] = predicted_variance(folder, frames)
    return results


def published(folder: Path) -> dict[str, float]:
    """Medians over the published maps; read noise in electrons rms over all pixels, and of the median pixel."""
    from noiseflow.io import read

    gain, offset, variance = (
        read(folder / f"{name}.tif").data for name in ("gain_counts_per_electron", "offset_counts", "variance_counts2")
    )
    return {
        "gain": float(np.median(gain)),
        "offset": float(np.median(offset)),
        "read_noise_median_pixel": float(np.median(np.sqrt(variance) / gain)),
        "read_noise_rms": float(np.sqrt(np.mean(variance / gain**2))),
    }


def predicted_variance(folder: Path, frames: Image) -> dict[str, Any]:
    """Variance of frame differences over what the maps predict: for all pixels, the dim 60 %, and those that stand still."""
    from calibration.exposures.frames import rounding_step
    from calibration.exposures.masks import restless
    from calibration.exposures.scaling import ring_mean
    from noiseflow.io import read

    gain, offset, variance = (
        np.asarray(read(folder / f"{name}.tif").data, float)
        for name in ("gain_counts_per_electron", "offset_counts", "variance_counts2")
    )
    mean = frames.mean(0)
    measured = np.mean(np.diff(frames, axis=0) ** 2, axis=0) / 2
    expected = gain * np.maximum(mean - offset, 0) + variance
    dim = mean <= np.percentile(mean, 60)
    residual = (frames - mean) * len(frames) / (len(frames) - 1)
    every, centred = np.ones(mean.shape, bool), residual - residual.mean(axis=(1, 2), keepdims=True)
    still = ~restless(centred, ring_mean(mean, every), every, step=rounding_step(frames[0]))
    shares = {
        name: float(measured[mask].sum() / expected[mask].sum())
        for name, mask in (("dim", dim), ("all", np.ones_like(dim)), ("still", still))
    }
    return shares | {"still_pixels": float(still.mean()), "frames": len(frames)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parts = ("registration", "parameters", "multiplied", "real")
    parser.add_argument(
        "part", nargs="?", choices=(*parts, "page"), help="default: all, the real data where --data is given"
    )
    parser.add_argument("--trials", type=int, default=None, help="default: 400 registrations, 300 parameter sets")
    parser.add_argument("--first-seed", type=int, default=None, help="default: 20000 registration, 0 parameters")
    parser.add_argument("--rows", type=Path, default=ROWS, help="folder of the trials' results, gone on with")
    parser.add_argument("--data", type=Path, default=None, help="folder with exposures_miro/ and detector_zhuang/")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--minutes", type=float, default=600.0, help="stop after the trials done by then; 0: only what is kept already"
    )
    arguments = parser.parse_args()
    if arguments.part == "page":
        from benchmarks.pages import calibration_page

        calibration_page.write(json.loads(RESULTS.read_text(encoding="utf-8")))
        return
    from benchmarks.provenance import origin

    for part in [arguments.part] if arguments.part else [part for part in parts if part != "real" or arguments.data]:
        started = time.perf_counter()
        result = measure(part, arguments) | {"seconds": time.perf_counter() - started} | origin()
        RESULTS.parent.mkdir(exist_ok=True)
        stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.write_text(json.dumps(stored | {part: result}, indent=1) + "\n")
        print(part, json.dumps(result, indent=1))


def measure(part: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """The figures of one part."""
    if part in ("registration", "parameters"):
        first = FIRST_SEED[part] if arguments.first_seed is None else arguments.first_seed
        seeds = range(first, first + (arguments.trials or NUM_TRIALS[part]))
        trials = registration if part == "registration" else parameters
        return trials(seeds, arguments.workers, arguments.minutes, arguments.rows)
    return real(arguments.data) if part == "real" else multiplied()


if __name__ == "__main__":
    main()
