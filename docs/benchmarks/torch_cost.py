"""Seconds and GB per 10⁶ pixels of likelihoods, gradients and draws, each in a process of its own; writes torch.md's table.

OMP_NUM_THREADS=2 python docs/benchmarks/torch_cost.py            all rows, median of three
python docs/benchmarks/torch_cost.py --one "8-bit spline" float32 gradient 1000000
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch

import noiseflow as nf


def camera() -> nf.Digitised:
    """The guide's 16-bit camera."""
    return nf.Digitised(nf.PoissonGaussian(2, 100, 1.2), 1, 0, 65535)


class TorchNormal(torch.nn.Module):
    """What torch itself needs for the simplest noise: the yardstick."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = torch.nn.Parameter(torch.tensor(-2.3))

    def forward(self, signal: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(signal, self.log_scale.exp())


class Zuko(torch.nn.Module):
    """zuko's neural spline flow of one number, conditioned on the signal."""

    def __init__(self) -> None:
        super().__init__()
        import zuko

        self.flow = zuko.flows.NSF(features=1, context=1, transforms=1, hidden_features=(32, 32))

    def forward(self, signal: torch.Tensor) -> Any:
        return self.flow(signal[..., None])


MODELS: dict[str, tuple[Callable[[], Any], float, float]] = {
    "torch Normal": (TorchNormal, 0.0, 1.0),
    "zuko NSF": (Zuko, 0.0, 1.0),
    "Gaussian": (nf.Gaussian, 0.0, 1.0),
    "spline flow": (nf.SplineFlow, 0.0, 1.0),
    "8-bit spline flow": (lambda: nf.Digitised(nf.SplineFlow(), 1 / 255, 0.0, 1.0), 0.0, 1.0),
    "mixture of 3": (nf.Mixture, 0.0, 1.0),
    "Poisson-Gaussian": (lambda: nf.PoissonGaussian(2, 100, 1.2), 100.0, 2000.0),
    "16-bit camera": (camera, 100.0, 2000.0),
    "physics and flow": (lambda: nf.PhysicsFlow(detector=nf.PoissonGaussian(2, 100, 1.2)), 100.0, 2000.0),
}
TASKS = (
    "gradient",
    "no gradient, first",
    "no gradient, again",
    "no gradient, wider range",
    "draws, first",
    "draws, again",
)


def measure(name: str, dtype: torch.dtype, task: str, count: int) -> dict[str, float]:
    """Seconds and peak GB above the inputs, both per 10⁶ pixels."""
    make, low, high = MODELS[name]
    model, generator = make(), torch.Generator().manual_seed(0)
    signal = (low + (high - low) * torch.rand(count, generator=generator)).to(dtype)
    seen = torch.cat([model(part).sample().detach().reshape(-1) for part in signal.split(2**14)])
    signal.requires_grad_(task == "gradient")
    wider = signal.detach() + 0.2 * (high - low) * (signal.detach() - low) / (high - low)
    torch.set_grad_enabled(task == "gradient")

    def likelihood(at: torch.Tensor) -> torch.Tensor:
        distribution = model(at)
        return distribution.log_prob(seen[..., None] if distribution.event_shape else seen)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if task in ("no gradient, again", "no gradient, wider range"):
        likelihood(signal)
    if task == "draws, again":
        model(signal).sample()
    started = time.perf_counter()
    if task == "gradient":
        likelihood(signal).sum().backward()
    elif task.startswith("draws"):
        model(signal).sample()
    else:
        likelihood(wider if task.endswith("range") else signal)
    seconds = time.perf_counter() - started
    gigabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
    return {"seconds": seconds * 1e6 / count, "gigabytes": gigabytes * 1e6 / count}


def median_of_processes(name: str, dtype: str, task: str, count: int, times: int) -> dict[str, float] | None:
    """None where the model's package is not installed or the task fails."""
    command = [sys.executable, __file__, "--one", name, dtype, task, str(count)]
    runs = [subprocess.run(command, capture_output=True, text=True, check=False) for _ in range(times)]
    found = [json.loads(run.stdout.splitlines()[-1]) for run in runs if run.returncode == 0]
    return {key: median(each[key] for each in found) for key in found[0]} if found else None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--one", nargs=4, metavar=("MODEL", "DTYPE", "TASK", "COUNT"))
    parser.add_argument("--count", type=int, default=10**6)
    parser.add_argument("--times", type=int, default=3)
    given = parser.parse_args()
    if given.one:
        name, dtype, task, count = given.one
        print(json.dumps(measure(name, getattr(torch, dtype), task, int(count))))
        return
    print("| model | type | " + " | ".join(TASKS) + " |\n|---|---|" + "---|" * len(TASKS))
    for name in MODELS:
        for dtype in ("float32", "float64", "bfloat16"):
            cells = []
            for task in TASKS:
                found = median_of_processes(name, dtype, task, given.count, given.times)
                cells.append("–" if found is None else f"{found['seconds']:.3f} s, {found['gigabytes']:.2f} GB")
            print(f"| {name} | {dtype} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
