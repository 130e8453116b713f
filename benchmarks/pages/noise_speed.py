"""Speed of fitting, sampling and the likelihood, as ratios to NumPy's Poisson generator and torch's normal density in one run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.divergences import kl_divergence
from benchmarks.pages.noise_accuracy import OURS, fit
from benchmarks.pages.noise_truths import clean_image, noises
from noiseflow.commands.console import Output

SPEED_MODELS = ("RadialFlow", "SplineFlow", "zuko", "normflows", "paper")
SAMPLE_SIDE, LOG_PROB_COUNT, RIVAL_COUNT = 1000, 10_000_000, 1_000_000
_CHUNK = 2**18


def speed(device: torch.device, output: Output, *, noise: str = "gamma") -> Iterator[dict[str, Any]]:
    """Fit each model to a 512² pair, then time it; yields a row for its fit, its sampling and its likelihood.

    The first call of sampling and likelihood, which makes our tables, is timed apart from the later ones, which take turns with
    the yardstick. Rivals are timed on a tenth of the pixels for the likelihood; the yardstick then has as many.
    """
    truth, signals = noises()[noise].model, noises()[noise].signals
    clean = clean_image(*signals).reshape(-1)
    with torch.no_grad():
        noisy = truth(clean).sample(generator=torch.Generator().manual_seed(0))
    apart = torch.from_numpy(np.random.default_rng(0).random(clean.numel()) < 0.2)
    for name in SPEED_MODELS:
        started = time.process_time()
        model, _ = fit(name, clean, noisy, apart, num_steps=500, seed=0)
        seconds = time.process_time() - started
        kl, error = kl_divergence(truth, model, clean, seed=1000)
        fitted = {"model": name, "what": "fit", "device": "cpu", "noise": noise, "seconds": seconds}
        output.line(f"{name}: fit of a 512² pair {seconds:.2f} s, KL {kl:.4f} ± {error:.4f} nats")
        yield fitted | {"kl": kl, "kl_error": error}
        for timed in (_sampling(name, model.to(device), device), _likelihood(name, model, clean, noisy, device)):
            row = {"model": name, "device": device.type} | timed
            output.line(
                f"  {row['what']}, {row['pixels']:.0e} pixels: first {row['first']:.3f} s, later {row['later']:.4f} s, "
                f"{row['later'] / row['yardstick']:.2f} × {row['yardstick_name']}, {row['pixels'] / row['later'] / 1e9:.3f} Gpx/s"
            )
            yield row


def _sampling(name: str, model: nn.Module, device: torch.device) -> dict[str, Any]:
    image = nn.functional.interpolate(clean_image(0, 1)[None, None], (SAMPLE_SIDE, SAMPLE_SIDE))[0, 0].contiguous()
    rates, random = 100 * image.double().numpy(), np.random.default_rng(0)
    pixels, generator = image.reshape(-1).to(device), torch.Generator(device).manual_seed(0)

    def sample() -> None:
        for part in _parts(name, pixels):
            model(part).sample(generator=generator)

    timed = _timed(sample, lambda: random.poisson(rates), device)
    return {"what": "sample", "pixels": pixels.numel(), "yardstick_name": "numpy Poisson"} | timed


def _likelihood(name: str, model: nn.Module, clean: Tensor, noisy: Tensor, device: torch.device) -> dict[str, Any]:
    count = LOG_PROB_COUNT if name in OURS else RIVAL_COUNT
    repeats = -(-count // clean.numel())
    signal, observation = (each.repeat(repeats)[:count].to(device) for each in (clean, noisy))
    normal = torch.distributions.Normal(signal, 0.1, validate_args=False)

    def log_prob() -> None:
        for one, other in zip(_parts(name, signal), _parts(name, observation), strict=True):
            model(one).log_prob(other)

    timed = _timed(log_prob, lambda: normal.log_prob(observation), device)
    return {"what": "log_prob", "pixels": count, "yardstick_name": "torch Normal"} | timed


def _parts(name: str, pixels: Tensor) -> tuple[Tensor, ...]:
    """Rivals keep all hidden units of all pixels they are given: they get them piece by piece."""
    return (pixels,) if name in OURS else torch.split(pixels, _CHUNK)


@torch.no_grad()
def _timed(function: Callable[[], object], yardstick: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Seconds of the first call, and medians of later ones that take turns with the yardstick."""
    first = _seconds(function, device)
    repeats = 7 if first < 2 else 2
    _seconds(yardstick, device)
    times = [(_seconds(yardstick, device), _seconds(function, device)) for _ in range(repeats)]
    ruler, later = (statistics.median(column) for column in zip(*times, strict=True))
    return {"first": first, "later": later, "yardstick": ruler, "repeats": repeats}


def _seconds(function: Callable[[], object], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    started = time.perf_counter()
    function()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started
