"""The pixels of fits, selections and evaluations: flat, finite and unmasked; of data sets that do not fit in memory, a sample."""

import math
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.arguments import check, check_precision, check_shapes, real
from noiseflow.arrays import as_tensor, floating, is_lazy, library_of, unmasked
from noiseflow.distributions.pixels import broadcast_shapes, needs_image
from noiseflow.fitting.signal_models import PART
from noiseflow.models.base import NoiseModelBase
from noiseflow.statistics import own_random

MOST_LAZY = 10**7
"""Number of pixels used from Dask arrays: about 50 bytes each, half a GB. The standard error of the mean log-likelihood is then
less than a thousandth of its standard deviation."""


def sample_pixels(*source: Any, most: int = 2**22, seed: int = 0) -> tuple[Tensor, ...]:
    """Signals and observations of a data set of any size, for `fit`, `select` and ``metrics.evaluate``, in bounded memory.

    Every pixel is read once. If there are more than `most`, a uniform random sample of them is returned: a flow fitted to four
    million pixels is less than 1e-3 nats per pixel from the best.

    Args:
        *source: signals and observations, and conditions if there are any: arrays (NumPy, memory-mapped, Zarr, HDF5, Dask; read
            in blocks that keep to their chunks), or lists of images, which may differ in size. Or one iterable of such tuples,
            such as a ``torch.utils.data`` `Dataset` or `DataLoader`.
        most: largest number of pixels to return.
        seed: seed of the sample.

    Returns:
        One (N,) tensor for each kind, of its own data type.

    Raises:
        ValueError: there are no pixels, lengths or shapes differ, or items are not tuples.

    Example:
        >>> import noiseflow, torch
        >>> images = torch.utils.data.TensorDataset(torch.zeros(4, 8, 8), 0.1 * torch.ones(4, 8, 8))
        >>> signal, observation = noiseflow.sample_pixels(torch.utils.data.DataLoader(images, batch_size=2), most=100)
        >>> signal.shape, observation.shape
        (torch.Size([100]), torch.Size([100]))
    """
    check(most=most, seed=seed)
    random, threshold = own_random(seed), 1.0
    several = source if len(source) > 1 else ()  # the length of a loader may be unknown
    lengths = {(getattr(each, "shape", ()) or [len(each) if hasattr(each, "__len__") else None])[0] for each in several}
    if None in lengths or len(lengths) > 1:
        raise ValueError("give arrays or lists of images of equal length, one observation for each signal")
    keys, kept = list[Tensor](), list[list[Tensor]]()
    for images in _images(source[0] if len(source) == 1 else [source]):
        shape = broadcast_shapes(*(image.shape for image in images))
        if kept and len(images) != len(kept[0]):
            raise ValueError(f"items have {len(kept[0])} and {len(images)} images; give equally many in each")
        key = torch.from_numpy(random.random(shape.numel()))
        chosen = torch.nonzero(key < threshold).squeeze(1)
        keys.append(key[chosen])
        kept.append([image.expand(shape).reshape(-1)[chosen.to(image.device)].clone() for image in images])
        if sum(each.numel() for each in keys) > 2 * most:
            keys, kept = _fewest(keys, kept, most)
            threshold = float(keys[0].max())
    if not kept or not keys[0].numel():
        raise ValueError("the data set has no pixels; give at least one signal and its observation")
    return tuple(_fewest(keys, kept, most)[1][0])


def bounded(noise_model: nn.Module, *arrays: Any) -> list[Any]:
    """Signal, observation and other arguments of which some are arrays of their shape, as given, or a sample of their pixels if
    these are more than `MOST_LAZY` and the model takes single pixels: fits need a hundred bytes for each."""
    which = [place for place, each in enumerate(arrays) if getattr(each, "ndim", 0)]
    given = [arrays[place] for place in which]
    in_memory = any(np.ma.isMaskedArray(each) or library_of(each) == "pandas" for each in given)
    shapes = {tuple(each.shape) for each in given}
    few = in_memory or which[:2] != [0, 1] or len(shapes) > 1 or math.prod(shapes.pop()) <= MOST_LAZY
    drawn = [] if few or needs_image(noise_model) else sample_pixels(*given, most=MOST_LAZY)
    found = dict(zip(which, drawn, strict=False))
    return [found.get(place, each) for place, each in enumerate(arrays)]


def _fewest(keys: list[Tensor], kept: list[list[Tensor]], most: int) -> tuple[list[Tensor], list[list[Tensor]]]:
    """The pixels of the smallest keys, in their order, as one block."""
    key, whole = torch.cat(keys), [torch.cat(each) for each in zip(*kept, strict=True)]
    if key.numel() <= most:
        return [key], [whole]
    part = torch.from_numpy(np.sort(np.argpartition(key.numpy(), most)[:most]))
    return [key[part]], [[each[part.to(each.device)] for each in whole]]


def _images(items: Any) -> Iterator[list[Tensor]]:
    indexed = hasattr(items, "__getitem__") and hasattr(items, "__len__")
    for item in (items[i] for i in range(len(items))) if indexed else items:
        if not isinstance(item, (list, tuple)) or len(item) < 2:
            raise ValueError(f"an item of the data set is {type(item).__name__}; give tuples (signal, observation)")
        if isinstance(item[0], (list, tuple)):
            yield from _images(list(zip(*item, strict=True)))
        else:
            yield from _blocks([each if hasattr(each, "shape") else as_tensor(each) for each in item])


def _blocks(images: Sequence[Any]) -> Iterator[list[Tensor]]:
    """The images of one item, in blocks of bounded size that keep to the chunks of the first image that has any."""
    shapes = [tuple(image.shape) for image in images]
    shape = broadcast_shapes(*shapes)  # or an error that names them
    chunked = (each.chunks for each in images if getattr(each, "chunks", None) and tuple(each.shape) == shape)
    sides = [each if isinstance(each, int) else each[0] for each in next(chunked, (1,) * len(shape))]
    for axis in reversed(range(len(sides))):
        sides[axis] *= max(1, min(-(-shape[axis] // sides[axis]), PART // math.prod(sides)))
    for start in product(*(range(0, length, side) for length, side in zip(shape, sides, strict=True))):
        part = [slice(first, first + side) for first, side in zip(start, sides, strict=True)]
        places = [[part[k - len(own)] if n > 1 else slice(None) for k, n in enumerate(own)] for own in shapes]
        yield [as_tensor(image[tuple(place)]) for image, place in zip(images, places, strict=True)]


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
    shared = any(part.shared_axis is not None for part in model.modules() if isinstance(part, NoiseModelBase))
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
