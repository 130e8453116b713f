"""Keyword arguments that a function takes over from a dataclass: shown by help and completion, checked by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from difflib import get_close_matches
from functools import wraps
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


def takes_fields_of(kind: type) -> Callable[[Function], Function]:
    """Function decorator that replaces ``**settings`` in a signature by the fields of a dataclass, with their defaults.

    Args:
        kind: the dataclass.

    Example:
        >>> import inspect, recon
        >>> "num_steps" in inspect.signature(recon.reconstruct).parameters
        True
    """
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
                    raise TypeError(f"{function.__name__} has no argument {name!r}; {_nearest(name, known)}")
            return function(*arguments, **settings)

        checked.__signature__ = signature.replace(parameters=[*named, *own])  # type: ignore[attr-defined]
        return checked  # type: ignore[return-value]

    return decorate


def _nearest(name: str, known: list[str]) -> str:
    """The argument that was probably meant, or all of them."""
    alike = [one for one in known if name in one.split("_")] or get_close_matches(name, known, 1)
    return f"did you mean {alike[0]}?" if alike else f"it takes {', '.join(known)}"
