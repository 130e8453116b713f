"""Noise models against known truths, and their speed.

    python docs/benchmarks/noise_models.py                       # everything; writes docs/benchmarks/results/noise_models.json
    python docs/benchmarks/noise_models.py accuracy --noise gamma --seed 3
    python docs/benchmarks/noise_models.py speed

Accuracy: each model is fitted to a pair of a clean and a noisy image, 512² pixels, and judged on fresh noise by its divergence
from the truth (KL, nats per pixel), the Jensen–Shannon divergence of residuals over its floor, and the time to fit. Speed: ratios
to NumPy's Poisson generator and torch's normal density, measured in turn in one run, medians.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import noiseflow
from noiseflow import metrics
from noiseflow.console import Output
from noiseflow.selection import select

RESULTS = Path(__file__).parent / "results" / "noise_models.json"
SIDE = 512


class Truth(nn.Module):
    """Known noise: `shape` is a torch distribution of standardised noise, scaled by `scale(signal)` around the signal."""

    def __init__(
        self, shape: torch.distributions.Distribution, scale: Callable[[Tensor], Tensor], mean: float = 0.0
    ) -> None:
        super().__init__()
        self.shape, self.scale, self.mean = shape, scale, mean

    def forward(self, signal: Tensor) -> TruthDistribution:
        return TruthDistribution(self, signal)


class TruthDistribution:
    def __init__(self, truth: Truth, signal: Tensor) -> None:
        self.truth, self.signal, self.scale = truth, signal, truth.scale(signal)

    def log_prob(self, value: Tensor) -> Tensor:
        standard = (value - self.signal) / self.scale + self.truth.mean
        inside = self.truth.shape.support.check(standard)
        safe = torch.where(inside, standard, torch.ones_like(standard))
        density = self.truth.shape.log_prob(safe) - torch.log(self.scale)
        return torch.where(inside, density, torch.full_like(density, -torch.inf))

    def sample(self, generator: torch.Generator) -> Tensor:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            return self.signal + self.scale * (self.truth.shape.sample(self.signal.shape) - self.truth.mean)


def growing(signal: Tensor) -> Tensor:
    """A standard deviation that grows like shot noise over read noise."""
    return torch.sqrt(0.03**2 + 0.07**2 * signal)


def truths() -> dict[str, tuple[nn.Module, tuple[float, float]]]:
    """Every noise, and the range of the clean image it is put on."""
    normal = torch.distributions.Normal(0.0, 1.0)
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(torch.tensor([0.99, 0.01])),
        torch.distributions.Normal(torch.zeros(2), torch.tensor([1.0, 10.0])),
    )
    found: dict[str, tuple[nn.Module, tuple[float, float]]] = {
        "Gaussian": (Truth(normal, lambda s: torch.full_like(s, 0.1)), (0, 1)),
        "signal-dependent": (Truth(normal, growing), (0, 1)),
        "Student-t (3)": (Truth(torch.distributions.StudentT(3.0), lambda s: 0.6 * growing(s)), (0, 1)),
        "gamma": (Truth(torch.distributions.Gamma(4.0, 2.0), growing, mean=2.0), (0, 1)),
        "outliers": (Truth(mixture, growing), (0, 1)),
        "clipped": (noiseflow.Digitised(Analytic(growing), step=0.0, low=0.0, high=1.0), (0, 1)),
        "8-bit": (noiseflow.Digitised(Analytic(growing), step=1 / 255, low=0.0, high=1.0), (0, 1)),
    }
    for rate in (0.5, 3.0, 50.0):
        for read_noise in (0.2, 0.5):
            model = noiseflow.PoissonGaussian(gain=1.0, offset=0.0, read_noise=read_noise)
            found[f"Poisson–Gaussian λ={rate:g} σ={read_noise:g}"] = (model, (0.5 * rate, 1.5 * rate))
    return found


class Analytic(nn.Module):
    """Gaussian noise of given signal dependence, as a noise model."""

    def __init__(self, scale: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, signal: Tensor) -> noiseflow.baselines.GaussianDistribution:
        return noiseflow.baselines.GaussianDistribution(signal, torch.log(self.scale(signal)))


MODELS = (
    "Gaussian",
    "SignalDependentGaussian",
    "PoissonGaussian",
    "Mixture",
    "RadialFlow",
    "SplineFlow",
    "PhysicsFlow",
)
"""All noise models, simplest first."""


def clean_image(low: float, high: float) -> Tensor:
    """A smooth field of all signal levels, (512, 512)."""
    x = torch.linspace(0, 1, SIDE)
    field = 0.5 + 0.25 * (torch.sin(7 * x[None, :] + 2 * x[:, None]) + torch.cos(11 * x[:, None] * x[None, :]))
    return low + (high - low) * field


def accuracy(output: Output, only: list[str], models: list[str], seed: int, size: int) -> list[dict[str, object]]:
    """Fit every model to every noise; print and return one row per model and noise."""
    rows: list[dict[str, object]] = []
    for name, (truth, signals) in truths().items():
        if only and name not in only:
            continue
        clean = clean_image(*signals)[:: SIDE // size, :: SIDE // size].contiguous()
        with torch.no_grad():
            noisy = truth(clean).sample(generator=torch.Generator().manual_seed(seed))
            fresh = truth(clean).sample(generator=torch.Generator().manual_seed(seed + 1000)).reshape(-1)
        found = select(clean, noisy, candidates={model: getattr(noiseflow, model)() for model in models}, seed=seed)
        for candidate in found.candidates:
            kl, error = metrics.kl_divergence(truth, candidate.model, clean.reshape(-1), seed=seed + 1000)
            divergence = metrics.divergence(candidate.model, clean.reshape(-1), fresh)
            row = {"noise": name, "model": candidate.name, "kl": kl, "kl_error": error, "seconds": candidate.seconds}
            row |= {"jsd": divergence.jsd, "jsd_floor": divergence.jsd_floor, "chosen": candidate is found.chosen}
            rows.append(row)
        output.line(f"\n{name}  (rounding and rails found: {found.digitisation})")
        output.table(
            ("model", "KL (nats)", "± s.e.", "JSD/floor", "fit (s)", "chosen"),
            [
                (
                    str(row["model"]),
                    f"{row['kl']:.4f}",
                    f"{row['kl_error']:.4f}",
                    f"{row['jsd'] / row['jsd_floor']:.2f}",  # type: ignore[operator]
                    f"{row['seconds']:.1f}",
                    "*" if row["chosen"] else "",
                )
                for row in rows
                if row["noise"] == name
            ],
        )
    return rows


def speed(output: Output) -> dict[str, dict[str, float]]:
    """Time sampling and likelihood against their yardsticks, in turn in one run."""
    clean, generator = clean_image(0, 1), torch.Generator().manual_seed(0)
    noisy = clean + growing(clean) * torch.randn(clean.shape, generator=generator)
    image = nn.functional.interpolate(clean[None, None], (1000, 1000))[0, 0].contiguous()
    rates, random = 100 * image.double().numpy(), np.random.default_rng(0)
    signal = image.reshape(-1).repeat(10)
    observation = signal + growing(signal) * torch.randn(signal.shape, generator=generator)
    normal = torch.distributions.Normal(signal, 0.1, validate_args=False)
    found: dict[str, dict[str, float]] = {}
    for name in ("RadialFlow", "SplineFlow"):
        model = getattr(noiseflow, name)(mean_preserving=True)
        noiseflow.fit(model, clean, noisy)
        with torch.no_grad():
            sampling = interleaved(lambda: random.poisson(rates), lambda: model(image).sample(generator=generator))  # noqa: B023
            density = interleaved(lambda: normal.log_prob(observation), lambda: model(signal).log_prob(observation))  # noqa: B023
        found[name] = {
            "sample_ms": 1e3 * sampling[1],
            "numpy_poisson_ms": 1e3 * sampling[0],
            "sample_ratio": sampling[1] / sampling[0],
            "log_prob_ms": 1e3 * density[1],
            "normal_log_prob_ms": 1e3 * density[0],
            "log_prob_ratio": density[1] / density[0],
        }
        output.line(
            f"{name}: sample 1000² at {found[name]['sample_ratio']:.2f} × numpy's Poisson, "
            f"log_prob of 10⁷ pixels at {found[name]['log_prob_ratio']:.2f} × the normal density"
        )
    return found


def interleaved(first: Callable[[], object], second: Callable[[], object], *, repeats: int = 7) -> tuple[float, float]:
    """Median seconds of two functions called in turn, after one call each."""
    times: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats + 1):
        for kept, function in zip(times, (first, second), strict=True):
            started = time.perf_counter()
            function()
            if repeat:
                kept.append(time.perf_counter() - started)
    return statistics.median(times[0]), statistics.median(times[1])


def main() -> None:
    """Run the benchmarks and write their results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="all", choices=("all", "accuracy", "speed"))
    parser.add_argument("--noise", action="append", default=[], help="only this noise; may be repeated")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=MODELS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=SIDE, choices=(64, 128, 256, 512), help="side of the image")
    parser.add_argument(
        "--out", type=Path, default=None, help="JSON file; by default the results folder for a full run"
    )
    options = parser.parse_args()
    output = Output(False)
    machine = {"processor": platform.machine(), "python": platform.python_version(), "torch": torch.__version__}
    results: dict[str, object] = {"machine": machine | {"threads": torch.get_num_threads()}}
    if options.what in ("all", "speed"):
        results["speed"] = speed(output)
    if options.what in ("all", "accuracy"):
        results["accuracy_size"] = options.size
        results["accuracy"] = accuracy(output, options.noise, options.models, options.seed, options.size)
    target = options.out or (RESULTS if options.what == "all" and not options.noise else None)
    if target is not None:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(results, indent=1) + "\n")
        output.line(f"\nwrote {target}")


if __name__ == "__main__":
    main()
