"""One row of the accuracy table: a model fitted to a known noise and judged on noise it has not seen."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import noiseflow
from benchmarks.divergences import kl_divergence
from benchmarks.pages import noise_rivals
from benchmarks.pages.noise_rivals import PaperFlow
from benchmarks.pages.noise_truths import clean_image, noises
from noiseflow import metrics
from noiseflow.commands.console import Output
from noiseflow.fitting.selection import select

OURS = ("Gaussian", "SignalDependentGaussian", "PoissonGaussian", "Mixture", "RadialFlow", "SplineFlow", "PhysicsFlow")
MODELS = ("automatic", *OURS, "zuko", "normflows", "paper", "paper-as-published")
"""Rows of every noise: the automatic choice, each of our models, the rivals."""
NOISES = tuple(noises())
_FRESH = 4
_HELD_OUT = 0.2


def measure(noise: str, model: str, *, size: int, num_steps: int, seed: int) -> dict[str, Any]:
    """Fit one model to one noise; all figures in nats per pixel."""
    truth, signals = noises()[noise].model, noises()[noise].signals
    clean = clean_image(*signals, size).reshape(-1)
    with torch.no_grad():
        noisy = truth(clean).sample(generator=torch.Generator().manual_seed(seed))
    # NumPy's stream: noise that was sampled with the same seed must not decide which pixels judge
    apart = torch.from_numpy(np.random.default_rng(seed).random(clean.numel()) < _HELD_OUT)
    started = time.process_time()
    fitted, row = fit(model, clean, noisy, apart, num_steps=num_steps, seed=seed)
    row["seconds"] = time.process_time() - started
    row = {"noise": noise, "model": model, "label": model, "size": size, "num_steps": num_steps, "seed": seed} | row
    judged = judge(truth, fitted, clean, noisy, apart, seed=seed)
    if "contest_nll" in row:  # the chosen model has learnt from the judging pixels since
        judged["nll_gap"] += row["contest_nll"] - judged["nll"]
        judged["nll"] = row["contest_nll"]
    return row | judged


def judge(
    truth: nn.Module, fitted: nn.Module, clean: Tensor, noisy: Tensor, apart: Tensor, *, seed: int
) -> dict[str, float]:
    """KL on fresh noise, the gap of the held-out likelihood to the truth's on the same pixels, marginal JSD and its floor."""
    kl, error = kl_divergence(truth, fitted, clean.repeat(_FRESH), seed=seed + 1000)
    divergences = []
    for draw in range(_FRESH):  # the floor of one draw alone varies by a fifth
        with torch.no_grad():
            fresh = truth(clean).sample(generator=torch.Generator().manual_seed(seed + 2000 + draw))
        divergences.append(metrics.divergence(fitted, clean, fresh))
    true, found = (metrics.pixel_log_prob(each, clean[apart], noisy[apart]) for each in (truth, fitted))
    row = {"kl": kl, "kl_error": error, "nll": -float(found.mean()), "nll_gap": float((true - found).mean())}
    mean = {name: sum(getattr(each, name) for each in divergences) / _FRESH for name in ("jsd", "jsd_floor")}
    return row | mean | {"jsd_draws": _FRESH}


def fit(
    name: str,
    clean: Tensor,
    noisy: Tensor,
    apart: Tensor,
    *,
    num_steps: int,
    seed: int,
    changes: dict[str, Any] | None = None,
) -> tuple[nn.Module, dict[str, Any]]:
    """A fitted model and what its row says of the fit; `changes` alter a rival's settings."""
    if name == "automatic":
        found = select(clean, noisy, held_out=apart, num_steps=num_steps, seed=seed)
        return found.chosen.model, {
            "label": f"automatic: {found.chosen.name}",
            "chosen": found.chosen.name,
            "contest_nll": found.chosen.nll,
        }
    signal, observation = clean[~apart], noisy[~apart]
    settings: dict[str, Any] = {}
    model: nn.Module
    digitisation = noiseflow.detect_digitisation(noisy.numpy(), clean.numpy())
    if name.startswith("paper"):
        model, row = _paper(signal, observation, as_published=name != "paper", seed=seed)
        return (noiseflow.Digitised(model, *digitisation) if digitisation.found else model), row
    if name in OURS:
        model = getattr(noiseflow, name)()
    else:
        model, settings = noise_rivals.make(name, changes or {})
    if digitisation.found:
        model = noiseflow.Digitised(model, *digitisation)
    steps = {"num_steps": settings.get("num_steps", num_steps)}
    rate = {"learning_rate": settings["learning_rate"]} if settings else {}
    generator = torch.Generator().manual_seed(seed)
    result = noiseflow.fit(model, signal, observation, digitise=False, generator=generator, **steps, **rate)
    return model, {"recoveries": result.recoveries, "settings": settings}


def _paper(signal: Tensor, observation: Tensor, *, as_published: bool, seed: int) -> tuple[nn.Module, dict[str, Any]]:
    model = PaperFlow(as_published=as_published)
    model.fit(signal, observation, seed=seed)
    row = {"integral": model.integral(float(signal.median()))}
    model.as_published = False  # what it samples has a density, whatever it was told while it learnt
    return model, row


SEARCH_NOISES = ("gamma", "student-t")
SEARCH_GRID = {"transforms": (1, 3), "learning_rate": (5e-3, 1.5e-2)}


def search(output: Output, *, size: int = 128, num_steps: int = 500) -> Iterator[dict[str, Any]]:
    """Mean KL of the rivals over two noises for every setting of a small grid; yields a row each."""
    for model in ("zuko", "normflows"):
        for values in itertools.product(*SEARCH_GRID.values()):
            setting = dict(zip(SEARCH_GRID, values, strict=True))
            started = time.perf_counter()
            kls = [_searched(model, noise, size, setting | {"num_steps": num_steps}) for noise in SEARCH_NOISES]
            row = {"model": model, "setting": setting, "kl": sum(kls) / len(kls), "size": size}
            row["seconds"] = (time.perf_counter() - started) / len(kls)
            output.line(f"{model} {setting}: mean KL {row['kl']:.4f}, {row['seconds']:.0f} s a fit")
            yield row


def _searched(model: str, noise: str, size: int, setting: dict[str, Any]) -> float:
    truth = noises()[noise]
    clean = clean_image(*truth.signals, size).reshape(-1)
    noisy = truth.model(clean).sample(generator=torch.Generator().manual_seed(1))
    apart = torch.from_numpy(np.random.default_rng(1).random(clean.numel()) < _HELD_OUT)
    fitted, _ = fit(model, clean, noisy, apart, num_steps=0, seed=1, changes=setting)
    return kl_divergence(truth.model, fitted, clean.repeat(_FRESH), seed=1000)[0]
