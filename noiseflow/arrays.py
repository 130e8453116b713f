"""Conversion between arrays and tensors: functions compute with tensors and return the type that they were given."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Given = TypeVar("Given", Tensor, NDArray[Any])


class Kind(Protocol):
    """An object with a data type and a device, such as a tensor."""

    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...


_WIDER = {"u2": np.int32, "u4": np.int64, "u8": np.int64}


def is_array(data: Any) -> bool:
    """Whether `data` is a number or an array of any library (``__array__`` or ``__dlpack__``), but not a tensor."""
    if isinstance(data, Tensor):
        return False
    return isinstance(data, (bool, int, float)) or hasattr(data, "__array__") or hasattr(data, "__dlpack__")


def is_lazy(data: Any) -> bool:
    """Whether `data` is a Dask array, or an xarray object backed by one."""
    return not isinstance(data, Tensor) and library_of(getattr(data, "data", data)) == "dask"


def library_of(data: Any) -> str:
    """The top-level package that defines an object's class."""
    return type(data).__module__.split(".")[0]


def as_tensor(data: Any, *, like: Kind | None = None) -> Tensor:
    """Convert a number, an array of any library, or a tensor to a tensor. Memory is shared where possible. Raises ValueError if
    the array is not of real numbers, or some values are masked.

    Args:
        data: real numbers or booleans, any shape; a tensor is returned unchanged.
        like: convert arrays to the data type and device of this tensor or projector; tensors are not converted.
    """
    if isinstance(data, Tensor):
        return data
    if np.ma.is_masked(data):
        raise ValueError(
            "some values of this array are masked; exclude them (mask=~array.mask, if the function has that argument) or "
            "fill them with array.filled(value)"
        )
    capsule = hasattr(data, "__dlpack_device__")
    # 1 is the CPU in the DLPack standard
    if capsule and (data.__dlpack_device__()[0] != 1 or not hasattr(data, "__array__")):
        tensor: Tensor = torch.utils.dlpack.from_dlpack(data)
    else:
        try:
            array = np.asarray(data)
        except ValueError as error:
            raise ValueError("the images differ in size; join their pixels by noiseflow.sample_pixels") from error
        tensor = _from_numpy(array)
    return tensor if like is None else tensor.to(device=like.device, dtype=like.dtype)


def _from_numpy(array: NDArray[Any]) -> Tensor:
    if array.dtype.kind not in "buif":
        raise ValueError(f"an array of type {array.dtype} is not real-valued; convert it first with .astype(float)")
    kind = _WIDER.get(array.dtype.str[1:], np.float64 if array.dtype.itemsize > 8 else array.dtype.newbyteorder("="))
    return torch.from_numpy(np.require(array, kind, ["C", "W"]))


def strided(array: NDArray[Any], most: int = 256) -> NDArray[Any]:
    """Every n-th element along each axis, at most `most` per axis: enough to choose the grey levels of a large array."""
    return array[tuple(slice(None, None, -(-size // most)) for size in array.shape)]


def unmasked(*arrays: Any) -> tuple[list[Any], Tensor | None]:
    """The arrays without masks, and a boolean (N,) of the values that are valid in all arrays; None if none is masked."""
    masks = [np.ma.getmaskarray(each).reshape(-1) for each in arrays if np.ma.is_masked(each)]
    bare = [np.ma.getdata(each) if isinstance(each, np.ma.MaskedArray) else each for each in arrays]
    return bare, torch.from_numpy(~np.logical_or.reduce(masks)) if masks else None


def floating(data: Any) -> Tensor:
    """As `as_tensor`, but integers, booleans and half precision are converted to the default floating-point type."""
    if isinstance(data, Tensor):
        return data
    tensor = as_tensor(data)
    exact = tensor.is_floating_point() and tensor.dtype != torch.float16
    return tensor if exact else tensor.to(torch.get_default_dtype())


def alike(result: Tensor | NDArray[Any], given: Given) -> Given:
    """Return the result as an array if `given` is an array, otherwise as a tensor on the device of `given`."""
    if isinstance(given, Tensor):
        return result if isinstance(result, Tensor) else torch.from_numpy(result).to(given.device)
    return result.detach().cpu().numpy() if isinstance(result, Tensor) else result
