"""Pixels of data sets that do not fit in memory, for fits, selections and evaluations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from noiseflow.arguments import check
from noiseflow.arrays import as_tensor
from noiseflow.distributions.pixel_batch import broadcast_shapes
from noiseflow.statistics import own_random

# Pixels read at once from one large array.
_BLOCK = 2**22


def sample_pixels(*source: Any, most: int = 2**22, seed: int = 0) -> tuple[Tensor, ...]:
    """Signals and observations of a data set of any size, for `fit`, `select` and ``metrics.evaluate``, in bounded memory.

    Every pixel is read once. If there are more than `most`, a uniform random sample of them is returned: a flow fitted to four
    million pixels is less than 1e-3 nats per pixel from the best.

    Args:
        *source: signals and observations, and conditions if there are any: arrays (NumPy, memory-mapped, Zarr, Dask; read in
            blocks along the first axis), or lists of images, which may differ in size. Or one iterable of such tuples, such as a
            ``torch.utils.data`` `Dataset` or `DataLoader`.
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
    if len({len(each) for each in source if hasattr(each, "__len__")}) > 1:
        raise ValueError("the arrays or lists differ in length; give one observation for each signal")
    keys: list[Tensor] = []
    kept: list[list[Tensor]] = []
    for images in _images(source[0] if len(source) == 1 else zip(*map(_blocks, source), strict=True)):
        try:
            shape = broadcast_shapes(*(image.shape for image in images))
        except ValueError as error:
            raise ValueError(
                f"the images of one item differ in shape: {[tuple(image.shape) for image in images]}"
            ) from error
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


def _fewest(keys: list[Tensor], kept: list[list[Tensor]], most: int) -> tuple[list[Tensor], list[list[Tensor]]]:
    """The pixels of the smallest keys, in their order, as one block."""
    key, whole = torch.cat(keys), [torch.cat(each) for each in zip(*kept, strict=True)]
    if key.numel() <= most:
        return [key], [whole]
    part = torch.from_numpy(np.sort(np.argpartition(key.numpy(), most)[:most]))
    return [key[part]], [[each[part.to(each.device)] for each in whole]]


def _blocks(images: Any) -> Iterator[Any]:
    """The images of a list, or blocks of an array along its first axis."""
    if isinstance(images, (list, tuple)):
        yield from images
        return
    if not getattr(images, "ndim", 0):
        raise ValueError("a single number is no image; give arrays or lists of images of equal length")
    step = max(1, _BLOCK // max(1, int(np.prod(images.shape[1:]))))
    yield from (images[start : start + step] for start in range(0, images.shape[0], step))


def _images(items: Any) -> Iterator[list[Tensor]]:
    indexed = hasattr(items, "__getitem__") and hasattr(items, "__len__")
    for item in (items[i] for i in range(len(items))) if indexed else items:
        if not isinstance(item, (list, tuple)) or len(item) < 2:
            raise ValueError(f"an item of the data set is {type(item).__name__}; give tuples (signal, observation)")
        if isinstance(item[0], (list, tuple)):
            yield from _images(list(zip(*item, strict=True)))
        else:
            yield [as_tensor(each) for each in item]
