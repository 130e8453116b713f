"""Noise that is narrow at the weak signals of most pixels: how far fits end from the truth along one to three square roots.

    python -m benchmarks.pages.weak_signals [--signals field decades weak powers] [--pixels 65536]

prints for each kind of signals and width of Gaussian noise the mean squared misfit of the measured log-widths along one to three
square roots (the first that exceeds none by 0.01 is taken), and the Kullback-Leibler divergence of fitted models from the truth,
nats per pixel, along one root and along those that the data ask for, of the first two and of all.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

import noiseflow
from benchmarks.divergences import kl_divergence
from benchmarks.pages.noise_truths import Analytic
from noiseflow.models import standardisation

WIDTHS: dict[str, Callable[[Tensor], Tensor]] = {
    "shot and read": lambda s: torch.sqrt(0.03**2 + 0.07**2 * s),
    "shot": lambda s: 0.01 * torch.sqrt(s + 1e-4),
    "speckle": lambda s: 0.1 * s + 1e-3,
    "speckle, no floor": lambda s: 0.2 * s,
    "speckle, low floor": lambda s: 0.2 * s + 2e-5,
    "constant": lambda s: torch.full_like(s, 0.1),
    "rising, then flat": lambda s: 2e-5 + 0.015 * (s / 0.15).clamp(max=1) ** 0.9,
    "sharply rising": lambda s: 4e-5 + 0.00996 * (s / 0.01).clamp(max=1) ** 2,
    "step": lambda s: 0.01 + 0.05 * torch.sigmoid(80 * (s - 0.5)),
    "falling": lambda s: 0.002 + 0.1 * (1 - s).clamp(min=0) ** 2,
}
"""Standard deviations by signal, 0 to 1."""


def _weak(count: int, generator: torch.Generator) -> Tensor:
    signal, weak = (torch.rand(count, generator=generator) for _ in range(2))
    return torch.where(weak < 0.6, 0.002 * signal, signal)


SIGNALS: dict[str, Callable[[int, torch.Generator], Tensor]] = {
    "field": lambda count, generator: torch.rand(count, generator=generator),
    "decades": lambda count, generator: (2 * torch.randn(count, generator=generator)).exp().clamp(max=3000) / 3000,
    "weak": _weak,
    "powers": lambda count, generator: torch.rand(count, generator=generator) ** 6,
    "six decades": lambda count, generator: 10 ** (-6 * torch.rand(count, generator=generator)),
}
"""Signals of the pixels: even, over decades, six tenths below 0.2 %, the sixth power of even ones, and six decades."""

MODELS = (noiseflow.SignalDependentGaussian, noiseflow.SplineFlow)


def row(signals: str, width: str, pixels: int) -> str:
    """One line of the table."""
    clean, truth = SIGNALS[signals](pixels, torch.Generator().manual_seed(5)), Analytic(WIDTHS[width])
    noisy = truth(clean).sample(generator=torch.Generator().manual_seed(3))
    fraction = (clean - clean.min()) / (clean.max() - clean.min())
    smallest = 1e-6 * float((noisy - clean).std())
    misfits = standardisation.misfits(fraction.double(), (noisy - clean).double(), smallest)
    text = f"{signals:11s} {width:19s} misfit " + " ".join(f"{each:.4f}" for each in misfits)
    for kind in MODELS:
        found = []
        for roots in ((1,), (1, 2), (1, 2, 3)):
            standardisation.ROOTS = roots
            fitted = noiseflow.fit(
                kind(), clean, noisy, digitise=False, generator=torch.Generator().manual_seed(1)
            ).noise_model
            found.append(kl_divergence(truth, fitted, clean, seed=9)[0])
        text += f"  {kind.__name__} " + " → ".join(f"{each:.5f}" for each in found)
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=list(SIGNALS))
    parser.add_argument("--pixels", type=int, default=65536)
    given = parser.parse_args()
    for signals in given.signals:
        for width in WIDTHS:
            print(row(signals, width, given.pixels), flush=True)


if __name__ == "__main__":
    main()
