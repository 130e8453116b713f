"""Checks of arguments: rules for numbers, pixels, masks, and names of keywords taken over from a dataclass."""

import inspect
import logging
import math
from collections.abc import Callable
from dataclasses import MISSING, fields
from difflib import get_close_matches
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from noiseflow.arrays import as_tensor
from noiseflow.statistics import SAMPLE

_log = logging.getLogger("noiseflow")
Rule = tuple[Callable[[float], bool], str]


def _whole(least: int) -> Rule:
    return (lambda value: value >= least and value == round(value), f"a whole number, at least {least}")


RULES: dict[str, Rule] = {
    **dict.fromkeys(
        ("gain", "read_noise", "scale", "variance", "learning_rate", "period"),
        (lambda value: 0 < value < math.inf, "a positive number"),
    ),
    **dict.fromkeys(("offset", "level", "start"), (math.isfinite, "a finite number")),
    **dict.fromkeys(("held_out", "dead_time"), (lambda value: 0 < value < 1, "a number above 0 and below 1")),
    **dict.fromkeys(("num_components", "num_bins", "num_signal_bins", "num_groups", "width", "most"), _whole(1)),
    **dict.fromkeys(("batch_size", "noise_interval"), _whole(1)),
    **dict.fromkeys(("num_steps", "noise_steps", "num_layers", "num_conditional", "reach", "seed"), _whole(0)),
    "neighbourhood": (lambda value: value >= 1 and value % 2 == 1, "the odd side of a window: 1, 3, 5, …"),
    "checkpoint_interval": (lambda value: 0 <= value < math.inf, "seconds, at least 0"),
    "share": (lambda value: 0 <= value < 1, "a share of the pixels, at least 0 and below 1"),
    "warm_up": (lambda value: 0 <= value < 1, "a share of the steps, at least 0 and below 1"),
    "excess_factor": (lambda value: 1 < value < math.inf, "a number above 1"),
    "step": (lambda value: 0 <= value < math.inf, "a positive rounding step, or 0 for clipping without rounding"),
}
"""What each argument must be, by its name; the same name means the same everywhere."""

_GROUPS = 16


def check(**arguments: Any) -> None:
    """Check numbers by the rule of their names; None and tensors, such as a mask for ``held_out``, are not checked. Raises
    ValueError if an argument breaks its rule.
    """
    for name, value in arguments.items():
        if value is None or (hasattr(value, "ndim") and value.ndim > 0):
            continue
        holds, wanted = RULES[name]
        try:
            good = not isinstance(value, bool | str) and holds(float(value))
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good:
            raise ValueError(f"{name} is {value!r}; give {wanted}")


def real(data: Any, name: str) -> Tensor:
    """An array of any library as a tensor of real numbers without gradient. Raises ValueError if it is missing or not real."""
    if data is None:
        raise ValueError(f"{name} is missing; give pixels, which noiseflow.sample_pixels takes from a data set")
    tensor = as_tensor(data).detach()
    wider = dict.fromkeys((torch.uint16, torch.uint32, torch.uint64), torch.int64)  # with which tensors do not compute
    return tensor.to((wider | {torch.bool: torch.get_default_dtype()}).get(tensor.dtype, tensor.dtype))


def check_shapes(**arrays: Any) -> None:
    """Check that arrays have one shape. Raises ValueError with their names if they do not."""
    shapes = {name: tuple(array.shape) for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"shapes must be equal: {', '.join(f'{name} has {shape}' for name, shape in shapes.items())}")


def flat_like(given: Any, observation: Tensor, name: str) -> Tensor:
    """An array with one real number for each pixel, (N,), on the device of the observation. Raises ValueError if it has neither
    the shape of the observation nor one axis with as many numbers."""
    found = real(given, name).to(observation.device)
    if found.shape != (observation.numel(),):
        check_shapes(**{name: found, "observation": observation})
    return found.reshape(-1)


def as_mask(mask: Any, observation: Tensor, name: str = "mask") -> Tensor:
    """A mask as a boolean tensor (N,) on the device of the observation; all true if there is none. Raises ValueError if the
    sizes differ, or the mask holds other values than 0 and 1, such as weights.
    """
    if mask is None:
        return torch.ones(observation.numel(), dtype=torch.bool, device=observation.device)
    flat = flat_like(mask, observation, name)
    if flat.dtype != torch.bool and not bool(((flat == 0) | (flat == 1)).all()):
        raise ValueError(f"{name} holds other values than 0 and 1; give True for the pixels that it selects")
    return flat.bool()


def as_weights(weights: Any, observation: Tensor) -> Tensor:
    """Weights as a float64 tensor (N,) on the device of the observation. Raises ValueError if the sizes differ, or weights are
    negative, not finite, or all 0.
    """
    flat = flat_like(weights, observation, "weights").double()
    if not bool((torch.isfinite(flat) & (flat >= 0)).all()) or not bool((flat > 0).any()):
        raise ValueError("some weights are negative, NaN or infinite, or all are 0; give at least one positive weight")
    return flat


def require_finite(finite: Tensor, remedy: str) -> None:
    """Raise ValueError if some pixels, (N,), are not finite."""
    if not bool(finite.all()):
        raise ValueError(f"{int((~finite).sum())} pixels of signal or observation are NaN or infinite; give {remedy}")


def check_precision(signal: Tensor, observation: Tensor) -> None:
    """Check that the number format resolves the noise of finite (N,) pixels. Raises ValueError if the spacing of the numbers
    exceeds half a standard deviation of the residuals; observations may be whole numbers, as rounded values are.
    """
    whole = bool((observation == observation.round()).all())
    kinds = [each.dtype for each in (signal, observation)[: 2 - whole] if each.is_floating_point()]
    if not kinds or not signal.numel():
        return
    far, single = float(observation.abs().max()), torch.finfo(torch.float32)  # of the parameters
    spacing = max(single.tiny, *(torch.finfo(kind).eps * far for kind in kinds))
    spread = float((observation.double() - signal.double()).std(correction=0))
    # adds spacing²/12 to the variance of each: from half a standard deviation on, 1e-3 nats per pixel
    if spread > 0 and (spread * 0.5 < spacing or far > single.max):
        raise ValueError(
            f"numbers near {far:g} are {spacing:.2g} apart in this precision or out of range, and the noise is {spread:.2g}; "
            "give float64 to a model of single pixels, subtract a constant from signal and observation, or choose another unit"
        )


def noise_width(signal: Tensor, observation: Tensor) -> float:
    """Median distance of finite (N,) pixels from the signal; their root mean square if that is 0."""
    away = (observation.double() - signal.double()).abs()
    return float(away.median()) or float(away.square().mean().sqrt())


def resolved_in_single(signal: Tensor, observation: Tensor, *, steps: int = 256) -> bool:
    """Whether the width of the noise of finite (N,) pixels is 0 or at least so many steps of single precision. Gaussian noise
    that grows fourfold with the signal loses nothing at 31 steps and 0.013 nats per pixel at 15; other noise may be narrower at
    some signals, or peaked."""
    return not 0 < noise_width(signal, observation) < steps * torch.finfo(torch.float32).eps * float(signal.abs().max())


def check_order(signal: Tensor, observation: Tensor, *, biased: float = 6.0, unbiased: float = 3.5) -> None:
    """Check that signal and observation, (N,) finite pixels, are not exchanged. Raises ValueError if the first argument is
    centred on the second at all of sixteen levels, without a slope, and the second is not on the first.

    Observations are centred on the signal at every signal; signals are not centred on the observation at every observation,
    because extreme observations have less extreme signals. So many standard errors of a mean residual, or its slope, show that
    they are biased, or that they are not: in sixteen groups of unbiased residuals, the largest exceeds 3.5 of them once in a
    hundred times, a single slope 2 in twenty.
    """
    every = max(1, signal.numel() // SAMPLE)
    first, second = (each.reshape(-1)[::every].double() for each in (signal, observation))
    # fewer pixels do not distinguish exchanged arguments from clipped observations
    if first.numel() < _GROUPS**3 or not any(bias > biased for bias in _biases(first, second)):
        return
    largest, slope = _biases(second, first)
    if largest < unbiased and slope < 2:
        raise ValueError("signal and observation seem exchanged: the first scatters about the second; swap them")


def _biases(given: Tensor, values: Tensor) -> tuple[float, float]:
    """Largest mean of values − given in sixteen groups by the given values, and its slope along them, in standard errors."""
    residual = values - given
    groups = torch.tensor_split(residual[torch.argsort(given)], _GROUPS)
    slope = (given - given.mean()) * (residual - residual.mean())
    errors = [abs(float(one.mean())) / max(float(one.std()) / one.numel() ** 0.5, 1e-30) for one in (*groups, slope)]
    return max(errors[:-1]), errors[-1]


Function = TypeVar("Function", bound=Callable[..., Any])


def takes_fields_of(kind: type) -> Callable[[Function], Function]:
    """Function decorator that replaces ``**settings`` in a signature by the fields of a dataclass, with their defaults."""
    own = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=field.type,
        )
        for field in fields(kind)
    ]

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        named = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        known = [one.name for one in (*named, *own) if one.kind is not inspect.Parameter.POSITIONAL_ONLY]

        @wraps(function)
        def checked(*arguments: Any, **settings: Any) -> Any:
            for name in settings:
                if name not in known:
                    near = [one for one in known if name in one.split("_")] or get_close_matches(name, known, 1)
                    advice = f"did you mean {near[0]}?" if near else f"it takes {', '.join(known)}"
                    raise TypeError(f"{function.__name__} has no argument {name!r}; {advice}")
            return function(*arguments, **settings)

        checked.__signature__ = signature.replace(parameters=[*named, *own])  # type: ignore[attr-defined]
        return checked  # type: ignore[return-value]

    return decorate
