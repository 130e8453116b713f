"""Whether error bars may be believed: the share of a known truth, or of pixels that no fit saw, that their intervals hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from recon.methods._registry import reconstruct
from recon.projection.base import from_rays, to_columns
from recon.projection.image_formation import Linear, Transmission
from recon.projection.projector import SliceProjector
from recon.series.orientation import Orientation
from recon.series.tilt_series import TiltSeries
from recon.uncertainty.posterior import Posterior
from recon.uncertainty.result import Uncertainty


def voxel_coverage(
    volume: NDArray[Any], uncertainty: Uncertainty, truth: NDArray[Any], *, level: float = 0.9
) -> NDArray[np.bool_]:
    """Where the interval around a voxel holds the truth, (z, y, x).

    Args:
        volume, truth: (z, y, x) attenuation per voxel.
        uncertainty: of the volume.
        level: share of the truth that the intervals should hold.
    """
    found: NDArray[np.bool_] = np.abs(volume - truth) <= uncertainty.half_width(level)
    return found


def predictive_ranks(noise_model: nn.Module, signals: Tensor, observation: Tensor, *, seed: int = 0) -> NDArray[Any]:
    """Rank of each observation in its predictive distribution, 0 to 1: the mean of F(observation | signal) over signals that were
    sampled. Ranks are uniform where noise model and signals are right (Dawid 1984, doi:10.2307/2981683); jumps of F, where a
    detector rounds or clips, are filled at random.

    Args:
        noise_model: conditional density of the observations.
        signals: (samples, ...) detector units.
        observation: (...) detector units.
        seed: of what fills the jumps.
    """
    below, at = torch.zeros(observation.shape, dtype=torch.float64), torch.zeros(observation.shape, dtype=torch.float64)
    with torch.no_grad():
        for signal in signals:
            distribution = noise_model(signal)
            below += distribution.cdf_below(observation).double().cpu() / len(signals)
            at += distribution.cdf(observation).double().cpu() / len(signals)
    share = np.random.default_rng(seed).random(tuple(observation.shape))
    ranks: NDArray[Any] = below.numpy() + share * np.maximum((at - below).numpy(), 0)
    return ranks


def share_within(ranks: NDArray[Any], level: float = 0.9) -> float:
    """The share of ranks inside the central interval: `level` where they are uniform."""
    return float((np.abs(ranks - 0.5) <= level / 2).mean())


def left_out_ranks(tilt_series: TiltSeries, *, every: int = 8, num_samples: int = 16, **settings: Any) -> NDArray[Any]:
    """Ranks of the pixels of tilts left out in their predictive distributions, see `predictive_ranks`.

    A volume is fitted to the other tilts, its posterior sampled, and each sample projected and put through the noise model.
    Samples are moved so that their mean is the volume, for it is the volume that error bars stand around.

    Args:
        tilt_series: with one detector response for all tilts.
        every: of so many tilts one is left out, and neither end.
        num_samples: of the posterior.
        **settings: of `recon.reconstruct`.

    Raises:
        ValueError: too few tilts, a response that differs from tilt to tilt, or a method that fits no volume.
    """
    order = np.argsort(tilt_series.tilt_angles, kind="stable")
    left = order[every // 2 : -1 : every]
    if every < 2 or not left.size:
        raise ValueError(
            f"{len(order)} tilts: leaving out one of {every} leaves nothing to judge by; give a smaller number"
        )
    kept, judged = tilt_series.select(np.setdiff1d(order, left)), tilt_series.select(left)
    orientation = Orientation.of(kept)  # that of the signal model
    kept, judged = orientation.series(kept), orientation.series(judged)
    kept = kept.select(np.argsort(kept.tilt_angles, kind="stable"))
    outcome = replace(reconstruct(kept, **settings), uncertainty=None)
    volumes: list[Tensor] = []
    posterior = Posterior(outcome, kept, num_samples, seed=settings.get("seed", 0), visit=volumes.append)
    while posterior.done < posterior.num_steps:
        posterior.step()
    model, observation = outcome.signal_model, torch.from_numpy(judged.images.astype(np.float32))
    formation = None if model is None else model.image_formation
    if outcome.noise_model is None or not isinstance(formation, Linear | Transmission):
        raise ValueError(f"method {outcome.method} has no noise model and response of its own; use --method joint")
    if any(parameter.numel() > 1 for parameter in formation.parameters()):
        raise ValueError("the response differs from tilt to tilt: what it is at tilts left out is not known")
    depth, _, width = volumes[0].shape
    moved = torch.from_numpy(outcome.volume.attenuation) - torch.stack(volumes).mean(0).cpu()
    pixels = judged.images.shape[2]
    A = SliceProjector(tilt_angles=judged.tilt_angles, depth=depth, width=width, detector_width=pixels)
    with torch.no_grad():
        rays = [from_rays(A.project(to_columns(volume.cpu() + moved)), len(left)) for volume in volumes]
        signals = torch.stack([formation.cpu()(each) for each in rays])
    ranks = predictive_ranks(outcome.noise_model.cpu(), signals, observation)
    use = np.ones(ranks.shape, np.bool_) if judged.mask is None else judged.mask
    found: NDArray[Any] = ranks[use]
    return found
