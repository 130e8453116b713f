"""What error bars cover: a known truth, and held-out pixels."""

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
from recon.series.views import view_numbers
from recon.uncertainty import Posterior, Uncertainty, unseen_range


def voxel_coverage(
    volume: NDArray[Any], uncertainty: Uncertainty, truth: NDArray[Any], *, level: float = 0.9
) -> NDArray[np.bool_]:
    """Whether the interval of each voxel contains the truth, (z, y, x).

    Args:
        volume, truth: (z, y, x) attenuation per voxel.
        uncertainty: error bars of the volume.
        level: nominal coverage of the intervals.
    """
    found: NDArray[np.bool_] = np.abs(volume - truth) <= uncertainty.half_width(level)
    return found


def predictive_ranks(noise_model: nn.Module, signals: Tensor, observation: Tensor, *, seed: int = 0) -> NDArray[Any]:
    """Rank of each observation in its predictive distribution, 0 to 1.

    The rank is the mean of F(observation | signal) over sampled signals. Ranks are uniform if noise model and signals are correct
    (Dawid 1984, doi:10.2307/2981683). They are randomised within jumps of F, where a detector rounds or clips.

    Args:
        noise_model: conditional density of the observations.
        signals: (samples, ...) detector units.
        observation: (...) detector units.
        seed: seed of the randomisation.
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
    """The share of ranks inside the central interval, which equals `level` if they are uniform."""
    return float((np.abs(ranks - 0.5) <= level / 2).mean())


def inner_views(tilt_angles: NDArray[np.float64], every: int) -> NDArray[np.bool_]:
    """(tilt,) evenly spaced views between others: one in `every`, but none beside the missing wedge. Raises ValueError if there
    are too few views."""
    numbers = view_numbers(tilt_angles)
    out: NDArray[np.bool_] = (numbers % max(every, 1) == every // 2) & (numbers < numbers.max())
    if every < 2 or not out.any():
        raise ValueError(
            f"{numbers.max() + 1} directions are too few to hold out one of {every}; give a smaller number"
        )
    return out


def left_out_ranks(tilt_series: TiltSeries, *, every: int = 8, num_samples: int = 16, **settings: Any) -> NDArray[Any]:
    """Ranks of the pixels of held-out tilts in their predictive distributions, see `predictive_ranks`.

    A volume is fitted to the other tilts and its posterior is sampled. Each sample is projected, and the noise model is applied.
    Samples are shifted so that their mean is the volume, because error bars are centred on it.

    Args:
        tilt_series: a series with one detector response for all tilts.
        every: one of this many directions is held out, with all its duplicates, but not those beside the missing wedge.
        num_samples: number of posterior samples.
        **settings: settings of `recon.reconstruct`.

    Raises:
        ValueError: there are too few tilts, the response differs between tilts, or the method does not fit a volume.
    """
    left = inner_views(tilt_series.tilt_angles, every)
    kept, judged = tilt_series.select(np.flatnonzero(~left)), tilt_series.select(np.flatnonzero(left))
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
        raise ValueError(f"method {outcome.method} does not fit a noise model and a response; use --method joint")
    if any(parameter.numel() > 1 for parameter in formation.parameters()):
        raise ValueError(
            "the response differs between tilts and is not known for held-out tilts; use a series with one response"
        )
    depth, _, width = volumes[0].shape
    moved = torch.from_numpy(outcome.volume.attenuation) - torch.stack(volumes).mean(0).cpu()
    pixels = judged.images.shape[2]
    A = SliceProjector(tilt_angles=judged.tilt_angles, depth=depth, width=width, detector_width=pixels)
    with torch.no_grad():
        rays = [from_rays(A.project(to_columns(volume.cpu() + moved)), judged.num_tilts) for volume in volumes]
        signals = torch.stack([formation.cpu()(each) for each in rays])
    ranks = predictive_ranks(outcome.noise_model.cpu(), signals, observation)
    use = np.ones(ranks.shape, np.bool_) if judged.mask is None else judged.mask
    found: NDArray[Any] = ranks[use]
    return found


def unseen_part(volume: NDArray[Any], tilt_angles: NDArray[Any]) -> NDArray[np.float32]:
    """The part of a volume (z, y, x) at frequencies that no tilt has seen; its mean is 0.

    Args:
        tilt_angles: (tilt,) degrees.
    """
    first, last = unseen_range(tilt_angles)
    z, x = np.fft.fftfreq(volume.shape[0]), np.fft.rfftfreq(volume.shape[2])
    angle = np.mod(np.degrees(np.arctan2(z[:, None], x)) - first, 180)
    angle[0, 0] = np.nan
    spectrum = np.fft.rfft2(volume, axes=(0, 2)) * ((angle > 0) & (angle < last - first))[:, None]
    found: NDArray[Any] = np.fft.irfft2(spectrum, s=(volume.shape[0], volume.shape[2]), axes=(0, 2))
    return found.astype(np.float32)
