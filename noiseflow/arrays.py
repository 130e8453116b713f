"""Arrays of any library: conversion to and from tensors, and noise distributions for them; Dask arrays stay lazy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Given = TypeVar("Given", Tensor, NDArray[Any])


class Kind(Protocol):
    """An object with a data type and a device, such as a tensor."""

    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...


HALF = (torch.float16, torch.bfloat16)
_WIDER = {"u2": np.int32, "u4": np.int64, "u8": np.int64}


def is_array(data: Any) -> bool:
    """Whether `data` is a number, a list, or an array of any library (``__array__`` or ``__dlpack__``), but not a tensor."""
    if isinstance(data, Tensor):
        return False
    return isinstance(data, (int, float, list, tuple)) or hasattr(data, "__array__") or hasattr(data, "__dlpack__")


def is_lazy(data: Any) -> bool:
    """Whether `data` is a Dask array, or an xarray object backed by one."""
    return not isinstance(data, Tensor) and library_of(getattr(data, "data", data)) == "dask"


def library_of(data: Any) -> str:
    """The top-level package that defines an object's class."""
    return type(data).__module__.split(".")[0]


def as_tensor(data: Any, *, like: Kind | None = None) -> Tensor:
    """Convert a number, an array of any library, or a tensor to a tensor. Memory is shared where possible. Raises ValueError if
    the array is not of real numbers (or a sparse, quantised or "meta" tensor), or some values are masked.

    Args:
        data: real numbers or booleans, any shape; a tensor is returned unchanged.
        like: convert arrays to the data type and device of this tensor or projector; tensors are not converted.
    """
    if isinstance(data, Tensor):
        if data.is_complex() or data.is_quantized or data.layout != torch.strided or data.device.type == "meta":
            kind = f"{data.dtype}, {data.layout}, on {data.device}"
            raise ValueError(f"a tensor ({kind}) does not hold real numbers; give a dense tensor of real pixel values")
        return data
    capsule = hasattr(data, "__dlpack_device__")
    # 1 is the CPU in the DLPack standard
    if capsule and (data.__dlpack_device__()[0] != 1 or not hasattr(data, "__array__")):
        tensor: Tensor = torch.utils.dlpack.from_dlpack(data)
    else:
        array = as_array(data)
        plain = np.float64 if array.dtype.itemsize > 8 else array.dtype.newbyteorder("=")
        tensor = torch.from_numpy(np.require(array, _WIDER.get(array.dtype.str[1:], plain), ["C", "W"]))
    return tensor if like is None else tensor.to(device=like.device, dtype=like.dtype)


def as_array(data: Any) -> NDArray[Any]:
    """Convert an array, a list, or a tensor on any device to a NumPy array, bfloat16 to single precision. Raises ValueError as
    `as_tensor`."""
    if isinstance(data, Tensor):
        data = as_tensor(data).detach().cpu()
        data = data.float() if data.dtype == torch.bfloat16 else data
    if np.ma.is_masked(data):
        raise ValueError("values of this array are masked; exclude (mask=~array.mask) or fill them (.filled(value))")
    try:
        array = np.asarray(data)
    except ValueError as error:
        raise ValueError("the images differ in size; join their pixels by noiseflow.sample_pixels") from error
    if array.dtype.kind not in "buif":
        raise ValueError(f"an array of type {array.dtype} is not real-valued; convert it first with .astype(float)")
    return array


def strided(array: NDArray[Any], most: int = 256) -> NDArray[Any]:
    """Every n-th element along each axis, at most `most` per axis: enough to choose the grey levels of a large array."""
    return array[tuple(slice(None, None, -(-size // most)) for size in array.shape)]


def unmasked(*arrays: Any) -> tuple[list[Any], Tensor | None]:
    """The arrays without masks, and a boolean (N,) of the values that are valid in all arrays; None if none is masked."""
    masks = [np.ma.getmaskarray(each).reshape(-1) for each in arrays if np.ma.is_masked(each)]
    bare = [np.ma.getdata(each) if isinstance(each, np.ma.MaskedArray) else each for each in arrays]
    return bare, torch.from_numpy(~np.logical_or.reduce(masks)) if masks else None


def floating(data: Any) -> Tensor:
    """As `as_tensor`, but integers, booleans and numbers in half precision are converted to the default floating-point type."""
    tensor = as_tensor(data)
    exact = tensor.is_floating_point() and tensor.dtype not in HALF
    return tensor if exact else tensor.to(torch.get_default_dtype())


def alike(result: Tensor | NDArray[Any], given: Given) -> Given:
    """Return the result as an array if `given` is an array, otherwise as a tensor on the device of `given`."""
    if isinstance(given, Tensor):
        return result if isinstance(result, Tensor) else torch.from_numpy(result).to(given.device)
    return result.detach().cpu().numpy() if isinstance(result, Tensor) else result


Wrap = Callable[[Any], Any]


def distribution_of_array(noise_model: nn.Module, signal: Any, *, needs_image: bool) -> ArrayDistribution:
    """Return the distribution that a noise model gives for an array of signals. Raises ValueError if the model needs images and
    the blocks of a Dask array cut them.

    Args:
        signal: array with ``__array__`` or ``__dlpack__``, any shape, detector units.
        needs_image: whether the model depends on neighbouring pixels, so that every block must hold whole images.
    """
    if not is_lazy(signal):
        return ArrayDistribution(noise_model, signal)
    blocks = getattr(signal, "data", signal).numblocks
    if needs_image and max(blocks[-2:], default=1) > 1:
        raise ValueError("blocks cut images, which this model needs whole; .rechunk() to span the last two axes")
    return LazyDistribution(noise_model, signal)


class ArrayDistribution:
    """The distribution of the observations, given an array of signals. Methods take and return arrays.

    The methods are those of `NoiseDistribution`, without gradients. xarray objects keep their coordinates, pandas objects
    their index, and masked arrays their mask.
    """

    def __init__(self, noise_model: nn.Module, signal: Any) -> None:
        self._wrap, bare, self._mask = _taken_apart(signal)
        self._like = floating(bare)
        self._like = self._like.to(next(noise_model.parameters(), self._like).device)
        self.tensors = noise_model(self._like)

    def __repr__(self) -> str:
        return f"ArrayDistribution({type(self.tensors).__name__} of {' x '.join(map(str, self._like.shape))} pixels)"

    def _ask(self, name: str, *values: Any) -> Any:
        bare, mask = [], self._mask
        for value in values:
            _, numbers, masked = _taken_apart(value)
            if masked is not None:
                numbers = np.asarray(numbers)
                unknown = numbers.dtype.type("nan") if numbers.dtype.kind == "f" else np.float32("nan")
                numbers = np.where(masked, unknown, numbers)
            tensor, kind = as_tensor(numbers).to(self._like.device), self._like.dtype
            narrow = tensor.is_floating_point() and torch.promote_types(tensor.dtype, kind) == kind
            # in a narrow type, values still equal the limit
            bare.append(tensor if narrow else tensor.to(kind))
            mask = masked if mask is None else mask if masked is None else mask | masked
        with torch.no_grad():
            found = getattr(self.tensors, name)
            found = (found(*bare) if callable(found) else found).detach().cpu().numpy()
        return self._given_back(np.asarray(found), mask)

    def _given_back(self, found: NDArray[Any], mask: NDArray[np.bool_] | None) -> Any:
        if mask is not None:
            return np.ma.MaskedArray(found, np.broadcast_to(mask, found.shape))
        return self._wrap(found)

    def log_prob(self, value: Any) -> Any:
        """Log-density in nats per detector unit; log-probability of the value for a digitised model."""
        return self._ask("log_prob", value)

    def log_interval_prob(self, low: Any, high: Any) -> Any:
        """log P(low < observation ≤ high)."""
        return self._ask("log_interval_prob", low, high)

    def cdf(self, value: Any) -> Any:
        """P(observation ≤ value)."""
        return self._ask("cdf", value)

    def cdf_below(self, value: Any) -> Any:
        """P(observation < value)."""
        return self._ask("cdf_below", value)

    def icdf(self, value: Any) -> Any:
        """Quantile: the smallest observation whose CDF reaches `value`."""
        return self._ask("icdf", value)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Any:
        """Draw observations, ``(*sample_shape, *signal.shape)``. For a Dask array, the draws also depend on its blocks."""
        drawn = self.tensors.sample(torch.Size(sample_shape), generator=generator).cpu().numpy()
        return self._given_back(np.asarray(drawn), self._mask)

    @property
    def mean(self) -> Any:
        """Mean of the observations of each pixel."""
        return self._ask("mean")

    @property
    def variance(self) -> Any:
        """Variance of the observations of each pixel."""
        return self._ask("variance")


class LazyDistribution(ArrayDistribution):
    """The distribution of a Dask array of signals. Every method returns a lazy Dask array, computed block by block."""

    def __init__(self, noise_model: nn.Module, signal: Any) -> None:
        self._model = noise_model
        self._wrap, self._signal, self._mask = _taken_apart(signal)

    def __repr__(self) -> str:
        return f"LazyDistribution({type(self._model).__name__} of {' x '.join(map(str, self._signal.shape))} pixels)"

    def _ask(self, name: str, *values: Any) -> Any:
        dask = import_module("dask.array")
        lazy = [dask.asanyarray(_taken_apart(value)[1]) for value in values]
        lazy = [dask.broadcast_to(each, self._signal.shape).rechunk(self._signal.chunks) for each in lazy]
        blocks = dask.map_blocks(partial(_ask_block, self._model, name), self._signal, *lazy, **self._numbers())
        return self._wrap(blocks)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Any:
        dask = import_module("dask.array")
        seed = int(torch.randint(2**62, (), generator=generator))
        shape = tuple(sample_shape)
        added = {"new_axis": list(range(len(shape)))} if shape else {}
        draw = partial(_sample_block, self._model, shape, seed)
        chunks = (*((size,) for size in shape), *self._signal.chunks)
        return self._wrap(dask.map_blocks(draw, self._signal, chunks=chunks, **added, **self._numbers(len(shape))))

    def _numbers(self, more_axes: int = 0) -> dict[str, Any]:
        kind = self._signal.dtype if self._signal.dtype in (np.float32, np.float64) else np.dtype(np.float32)
        return {"dtype": kind, "meta": np.empty((0,) * (self._signal.ndim + more_axes), kind)}

    @property
    def tensors(self) -> Any:
        """Not available, because the blocks are not computed yet."""
        raise AttributeError("a lazy distribution holds no tensors; call .compute() on the results of its methods")


def _ask_block(model: nn.Module, name: str, signal: NDArray[Any], *values: NDArray[Any]) -> Any:
    return ArrayDistribution(model, signal)._ask(name, *values)


def _sample_block(
    model: nn.Module, shape: tuple[int, ...], seed: int, signal: NDArray[Any], *, block_id: tuple[int, ...]
) -> NDArray[Any]:
    own = int(np.random.SeedSequence([seed, *block_id]).generate_state(1, np.uint64)[0] >> 1)
    device = next(model.parameters(), torch.empty(0)).device
    drawn: NDArray[Any] = ArrayDistribution(model, signal).sample(shape, torch.Generator(device).manual_seed(own))
    return drawn


def _taken_apart(data: Any) -> tuple[Wrap, Any, NDArray[np.bool_] | None]:
    """Return a function that restores the type of `data`, its plain values, and its mask or None."""
    library = library_of(data)
    if library == "xarray":
        return partial(_like_xarray, data), data.data, None
    if library == "pandas":
        return partial(_like_pandas, data), data.to_numpy(), None
    if isinstance(data, np.ma.MaskedArray):
        return lambda found: found, np.ma.getdata(data), np.ma.getmaskarray(data)
    return lambda found: found, data, None


def _like_xarray(given: Any, found: Any) -> Any:
    if found.shape == given.shape:
        return given.copy(data=found)
    draws = [f"draw_{number}" for number in range(found.ndim - given.ndim)] if found.ndim > given.ndim + 1 else ["draw"]
    return type(given)(found, dims=[*draws, *given.dims], coords=given.coords, name=given.name, attrs=given.attrs)


def _like_pandas(given: Any, found: NDArray[Any]) -> Any:
    if found.shape != given.shape:
        return found
    labels = {"columns": given.columns} if found.ndim == 2 else {"name": given.name}
    return type(given)(found, index=given.index, **labels)
