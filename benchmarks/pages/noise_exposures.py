"""The paper's noise table on pairs of known truth and on real exposure pairs: JSD, BC, distance and likelihood, with floors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import noiseflow
from benchmarks.pages.noise_truths import clean_image, noises
from noiseflow import metrics
from noiseflow.commands.console import Output

SIMULATED = ("gamma", "electrons-50-0.5")
EXPOSURES = tuple((channel, time) for channel in (1, 2, 3) for time in ("010", "050"))
KINDS = ("Poisson", "Gaussian", "SignalDependentGaussian", "RadialFlow", "SplineFlow")
SIDE = 400


def exposures(folder: Path | None, output: Output, *, num_steps: int = 500) -> Iterator[dict[str, Any]]:
    """Fit each kind of model to one half of the pixels of every pair and judge it on the other half; yields a row each.

    Args:
        folder: of the real exposures, ``exposures_miro``; None for the simulated pairs alone.
        output: where each row is told.
        num_steps: optimisation steps.

    Raises:
        ValueError: an exposure is missing.
    """
    for name, real, signal, observation in _pairs(folder):
        apart = torch.from_numpy(np.random.default_rng(0).random(signal.numel()) < 0.5)
        for kind in KINDS:
            model = getattr(noiseflow, kind)()
            result = noiseflow.fit(
                model,
                signal[~apart],
                observation[~apart],
                digitise=False,
                num_steps=num_steps,
                generator=torch.Generator().manual_seed(0),
            )
            found = metrics.evaluate(model, signal[apart], observation[apart])
            overall = found.overall
            row = {"data": name, "real": real, "model": kind, "num_pixels": found.num_pixels, "seconds": result.seconds}
            row |= {"nll": found.nll, "nll_error": found.nll_error, "jsd": overall.jsd, "jsd_floor": overall.jsd_floor}
            row |= {"bc": overall.bc, "bc_floor": overall.bc_floor, "bd": overall.bd, "bd_floor": overall.bd_floor}
            row |= {"jsd_per_signal": found.mean_jsd, "jsd_per_signal_floor": found.mean_jsd_floor}
            output.line(
                f"{name:28}{kind:26} JSD ×100 {100 * row['jsd']:.3f} (floor {100 * row['jsd_floor']:.3f})  "
                f"BC {row['bc']:.4f}  d ×10 {10 * row['bd']:.4f}  NLL {row['nll']:.4f} ± {row['nll_error']:.4f}"
            )
            yield row


def _pairs(folder: Path | None) -> Iterator[tuple[str, bool, Tensor, Tensor]]:
    """Name, whether real, and the signals and observations of each pair."""
    for noise in SIMULATED:
        clean = clean_image(*noises()[noise].signals)[:SIDE, :SIDE].reshape(-1)
        with torch.no_grad():
            noisy = noises()[noise].model(clean).sample(generator=torch.Generator().manual_seed(0))
        yield f"simulated: {noises()[noise].title}", False, clean, noisy
    for channel, time in EXPOSURES if folder is not None else ():
        signal, observation = _aligned(Path(str(folder)), channel, time)
        yield f"channel {channel}, {int(time)} ms", True, signal, observation


def _aligned(folder: Path, channel: int, time: str) -> tuple[Tensor, Tensor]:
    """A real short exposure and its signal from the long one, registered, scaled and rid of its own noise."""
    from calibration import align_pair, read_pairs

    short, long = (folder / f"channel{channel}_{name}.tif" for name in (f"{time}ms", "long"))
    (pair,) = read_pairs([short], [long])
    aligned = align_pair(pair)
    signal, observation = (
        torch.from_numpy(image[aligned.mask]).float() for image in (aligned.signal, aligned.observation)
    )
    return signal, observation
