"""Functions that take over the fields of a dataclass as keyword arguments."""

import inspect
from dataclasses import dataclass

import pytest

from noiseflow.arguments import takes_fields_of


@dataclass
class Options:
    num_steps: int = 3
    weight: float | None = None


@takes_fields_of(Options)
def run(data: int, *, other: int = 1, **settings: object) -> object:
    return data, other, settings


def test_signature_lists_every_field_with_its_default() -> None:
    assert list(inspect.signature(run).parameters) == ["data", "other", "num_steps", "weight"]
    assert inspect.signature(run).parameters["num_steps"].default == 3
    assert run(1, weight=2.0) == (1, 1, {"weight": 2.0})


@pytest.mark.parametrize(
    ("given", "meant"), [("steps", "num_steps"), ("weightt", "weight"), ("zzz", "num_steps, weight")]
)
def test_an_unknown_argument_is_answered_by_the_nearest(given: str, meant: str) -> None:
    with pytest.raises(TypeError, match=meant):
        run(1, **{given: 1})
