"""Pixels for the evaluation of a noise model: flat, finite and unmasked; from Dask arrays in bounded memory."""

from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.arguments import check_precision, check_shapes, real
from noiseflow.arrays import floating, is_lazy, unmasked
from noiseflow.statistics import own_random

MOST_LAZY = 10**7
"""Number of pixels used from Dask arrays: about 50 bytes each, half a GB. The standard error of the mean log-likelihood is then
less than a thousandth of its standard deviation."""


def judged_pixels(
    signal: Any, observation: Any, *, skip_non_finite: bool = False, seed: int = 0, most: int = MOST_LAZY
) -> tuple[Tensor, Tensor]:
    """Signals and observations for the evaluation, (N,) each.

    Args:
        signal, observation: tensors or arrays of equal shape; masked pixels are excluded.
        skip_non_finite: exclude pixels whose signal or observation is NaN or infinite, instead of raising an error.
        seed: seed of the sample if Dask arrays have more than `most` pixels.
        most: largest number of pixels taken from Dask arrays.

    Raises:
        ValueError: shapes differ, pixels are complex or not finite, there are no pixels, or their precision does not resolve
            the noise.
    """
    if is_lazy(signal) or is_lazy(observation):
        return _of_blocks(signal, observation, skip_non_finite, own_random(seed), most)
    (signal, observation), kept = unmasked(signal, observation)
    named = (signal, "signal"), (observation, "observation")
    signal, observation = (floating(real(*each)) for each in named)
    check_shapes(signal=signal, observation=observation)
    used = slice(None) if kept is None else kept.to(signal.device)
    signal, observation = signal.reshape(-1)[used], observation.reshape(-1)[used]
    if not signal.numel():
        raise ValueError("signal and observation have no pixels, or all are masked; give some to evaluate")
    return _finite(signal, observation, skip_non_finite)


def _finite(signal: Tensor, observation: Tensor, skip_non_finite: bool) -> tuple[Tensor, Tensor]:
    finite = torch.isfinite(signal) & torch.isfinite(observation)
    if bool(finite.all()):
        check_precision(signal, observation)
        return signal, observation
    if not (skip_non_finite and bool(finite.any())):
        raise ValueError(
            f"{int((~finite).sum())} of {finite.numel()} pixels of signal or observation are NaN or infinite; "
            "replace them, or exclude them with skip_non_finite=True"
        )
    return _finite(signal[finite], observation[finite], False)


def without_gaps(model: nn.Module, *images: Any) -> tuple[Tensor, ...]:
    """Which pixels of signal and observation are masked, NaN or infinite, and the images with the mean of the others there.
    Observations are missing there (NaN) if the model shares offsets, which they must not affect. Raises ValueError if shapes
    differ, or no pixel is left."""
    bare, use = unmasked(*images)
    signal, value = (floating(real(each, "an image")) for each in bare)
    check_shapes(signal=signal, observation=value)
    bad = ~(torch.isfinite(signal) & torch.isfinite(value))
    bad = bad if use is None else bad | ~use.to(bad.device).reshape(bad.shape)
    if bool(bad.all()):
        raise ValueError("the images have no pixels whose signal and observation are finite; give some")
    signal, fill = (torch.where(bad, each[~bad].mean(), each) for each in (signal, value))
    shared = any(getattr(part, "shared_axis", None) is not None for part in model.modules())
    return bad, signal, torch.where(bad, torch.nan, value) if shared else fill


def _of_blocks(
    signal: Any, observation: Any, skip_non_finite: bool, random: np.random.Generator, most: int
) -> tuple[Tensor, Tensor]:
    """Collect pixels block by block: the same share of every block, or all pixels if they are few enough."""
    dask, array = import_module("dask"), import_module("dask.array")
    lazy = [array.asanyarray(getattr(each, "data", each) if is_lazy(each) else each) for each in (signal, observation)]
    if lazy[0].shape != lazy[1].shape or not lazy[0].size:
        raise ValueError(f"signal and observation need equal, non-zero shapes, not {lazy[0].shape} and {lazy[1].shape}")
    lazy[1] = lazy[1].rechunk(lazy[0].chunks)
    parts, share = [], most / lazy[0].size
    for place in product(*map(range, lazy[0].numblocks)):
        blocks, kept = unmasked(*dask.compute(*(each.blocks[place] for each in lazy)))
        pair = torch.stack([floating(block).reshape(-1) for block in blocks])
        pair = pair if kept is None else pair[:, kept]
        if share < 1:
            pair = pair[:, np.sort(random.choice(pair.shape[1], round(share * pair.shape[1]), replace=False))]
        parts.append(pair)
    both = torch.cat(parts, 1)
    if not both.numel():
        raise ValueError("all pixels of signal or observation are masked; unmask the pixels to evaluate")
    return _finite(both[0], both[1], skip_non_finite)
