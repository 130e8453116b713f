"""NumPy arrays and torch tensors alike: functions compute with tensors and return what they were given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Given = TypeVar("Given", Tensor, NDArray[Any])


class Kind(Protocol):
    """What has a number type and a device, as tensors do."""

    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...


_WIDER = {"u2": np.int32, "u4": np.int64, "u8": np.int64}


def as_tensor(data: Tensor | NDArray[Any], *, like: Kind | None = None) -> Tensor:
    """A tensor of a tensor or an array; memory is shared where it can be.

    Args:
        data: real numbers or booleans, any shape; a tensor is returned as it is.
        like: take the number type and device of this tensor or projector over, for arrays alone.

    Raises:
        ValueError: the array's numbers are not real.
    """
    if isinstance(data, Tensor):
        return data
    array = np.asarray(data)
    if array.dtype.kind not in "buif":
        raise ValueError(f"an array of {array.dtype} has no real numbers; convert it first, with .astype(float)")
    kind = _WIDER.get(array.dtype.str[1:], np.float64 if array.dtype.itemsize > 8 else array.dtype.newbyteorder("="))
    tensor = torch.from_numpy(np.require(array, kind, ["C", "W"]))
    return tensor if like is None else tensor.to(device=like.device, dtype=like.dtype)


def floating(data: Tensor | NDArray[Any]) -> Tensor:
    """As `as_tensor`; an array of integers, booleans or half precision becomes the default floating type."""
    if isinstance(data, Tensor):
        return data
    tensor = as_tensor(data)
    exact = tensor.is_floating_point() and tensor.dtype != torch.float16
    return tensor if exact else tensor.to(torch.get_default_dtype())


def alike(result: Tensor | NDArray[Any], given: Given) -> Given:
    """The result as an array where an array was given, as a tensor on its device else."""
    if isinstance(given, Tensor):
        return result if isinstance(result, Tensor) else torch.from_numpy(result).to(given.device)
    return result.detach().cpu().numpy() if isinstance(result, Tensor) else result


def is_array(data: Any) -> bool:
    """Whether this is an array, and not a tensor."""
    return isinstance(data, np.ndarray)


def on_arrays(model: Callable[[Tensor], Any], signal: Any, device: torch.device) -> ArrayDistribution:
    """The distribution of an array of signals under a noise model that lives on a device."""
    pixels = floating(signal).to(device)
    return ArrayDistribution(model(pixels), pixels)


class ArrayDistribution:
    """The distribution of the observations of an array of signals; arrays in, arrays out.

    The methods are those of `NoiseDistribution`, without gradients.
    """

    def __init__(self, distribution: Any, like: Tensor) -> None:
        self.tensors, self._like = distribution, like

    def __repr__(self) -> str:
        return f"ArrayDistribution({type(self.tensors).__name__} of {' x '.join(map(str, self._like.shape))} pixels)"

    def _call(self, name: str, *values: NDArray[Any]) -> NDArray[Any]:
        with torch.no_grad():
            found = getattr(self.tensors, name)(*(as_tensor(np.asarray(v), like=self._like) for v in values))
        return np.asarray(found.cpu().numpy())

    def log_prob(self, value: NDArray[Any]) -> NDArray[Any]:
        """Log-density in nats per detector unit; of a digitised model, log-mass."""
        return self._call("log_prob", value)

    def log_interval_prob(self, low: NDArray[Any], high: NDArray[Any]) -> NDArray[Any]:
        """log P(low < observation ≤ high)."""
        return self._call("log_interval_prob", low, high)

    def cdf(self, value: NDArray[Any]) -> NDArray[Any]:
        """P(observation ≤ value)."""
        return self._call("cdf", value)

    def cdf_below(self, value: NDArray[Any]) -> NDArray[Any]:
        """P(observation < value)."""
        return self._call("cdf_below", value)

    def icdf(self, value: NDArray[Any]) -> NDArray[Any]:
        """The quantile: smallest observation whose CDF reaches `value`."""
        return self._call("icdf", value)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> NDArray[Any]:
        """Draw observations, ``(*sample_shape, *signal.shape)``."""
        return np.asarray(self.tensors.sample(sample_shape, generator=generator).cpu().numpy())

    @property
    def mean(self) -> NDArray[Any]:
        """Mean of each pixel's observations."""
        return np.asarray(self.tensors.mean.detach().cpu().numpy())

    @property
    def variance(self) -> NDArray[Any]:
        """Variance of each pixel's observations."""
        return np.asarray(self.tensors.variance.detach().cpu().numpy())
