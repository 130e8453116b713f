"""Joint fit against least squares at its best weight, and against the oracle that is told the true noise.

    python docs/benchmarks/joint.py                              # the 96³ scene of the README
    python docs/benchmarks/joint.py --size 64 --seeds 0 1 2      # others

For each scene: least squares + total variation at the best of many weights, with the incident intensity learnt and
known (the better one counts); the oracle, the same field and regulariser with the true noise, at its best weight; and
the joint fit as a user gets it, with no knowledge of either. Best weights are found by looking at the truth, which only
the rivals may do. PSNR is over the range of the truth, without any rescaling.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from noiseflow import Gaussian
from noiseflow.console import Output
from recon.joint import JointReconstructor
from recon.metrics import compare
from recon.phantoms import PHANTOMS, make_phantom
from recon.simulation import ACQUISITIONS, add_noise, clean_tilt_series, tilt_range
from recon.tilt_series import TiltSeries

HEADER = ("method", "weight", "volume PSNR", "projection PSNR", "seconds")


@dataclass(frozen=True)
class Scene:
    truth: np.ndarray
    clean: TiltSeries
    noisy: TiltSeries


@dataclass(frozen=True)
class Score:
    weight: float
    volume: float
    projections: float
    seconds: float

    def row(self, name: str) -> tuple[str, ...]:
        return name, f"{self.weight:.3g}", f"{self.volume:.2f}", f"{self.projections:.2f}", f"{self.seconds:.1f}"


def make_scene(phantom: str, noise: str, size: int, tilts: str, seed: int) -> Scene:
    density = make_phantom(phantom, size, generator=np.random.default_rng(seed))
    acquisition = ACQUISITIONS[noise]
    clean, unit = clean_tilt_series(density, tilt_range(tilts), acquisition=acquisition)
    return Scene(density * unit, clean, add_noise(clean, true_noise(noise), seed=seed + 1))


def true_noise(name: str) -> nn.Module:
    make = ACQUISITIONS[name].noise
    if make is None:
        raise ValueError(f"{name} has no noise to learn")
    return make()


def score(reconstructor: JointReconstructor, scene: Scene) -> Score:
    started = time.perf_counter()
    result = reconstructor(scene.noisy)
    seconds = time.perf_counter() - started
    volume = compare(result.volume.attenuation, scene.truth).psnr
    return Score(result.signal_model.weight, volume, compare(result.projections, scene.clean.images).psnr, seconds)


def best_weight(reconstructor: JointReconstructor, scene: Scene) -> Score:
    """The highest volume PSNR over weights, from a coarse ladder refined twice around its best rung."""
    scores: dict[float, Score] = {}

    def visit(weights: Iterable[float]) -> float:
        for weight in weights:
            if weight not in scores:
                scores[weight] = score(replace(reconstructor, weight=weight), scene)
        return max(scores, key=lambda weight: scores[weight].volume)

    best = visit([0.03, 0.1, 0.3, 1.0])
    for step in (math.sqrt(10 / 3), (10 / 3) ** 0.25):
        best = visit([best / step, best, best * step])
    return scores[best]


def rivals(noise: str) -> dict[str, Callable[[Scene], Score]]:
    least_squares = JointReconstructor(noise_model=Gaussian)
    oracle = JointReconstructor(noise_model=lambda: true_noise(noise))

    def of_two(reconstructor: JointReconstructor) -> Callable[[Scene], Score]:
        def run(scene: Scene) -> Score:
            variants = (replace(reconstructor, estimate_response=estimate) for estimate in (True, False))
            return max((best_weight(variant, scene) for variant in variants), key=lambda found: found.volume)

        return run

    return {
        "least squares, best weight": of_two(least_squares),
        "joint": lambda scene: score(JointReconstructor(), scene),
        "oracle, best weight": lambda scene: best_weight(oracle, scene),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--tilts", default="-59.5:58:1.5", help="START:STOP:STEP in degrees; 79 tilts by default")
    parser.add_argument("--phantoms", nargs="+", default=["shells"], choices=list(PHANTOMS))
    parser.add_argument(
        "--noises", nargs="+", default=["clipped"], choices=[name for name in ACQUISITIONS if name != "none"]
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    output = Output(json_mode=False)
    for phantom in arguments.phantoms:
        for noise in arguments.noises:
            for seed in arguments.seeds:
                scene = make_scene(phantom, noise, arguments.size, arguments.tilts, seed)
                psnr = compare(scene.noisy.images, scene.clean.images).psnr
                output.line(f"\n{phantom}, {noise} noise (images {psnr:.1f} dB), {arguments.size}³, seed {seed}")
                output.table(HEADER, [run(scene).row(name) for name, run in rivals(noise).items()])


if __name__ == "__main__":
    main()
