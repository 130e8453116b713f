"""Every public name has an example in its docstring, and the examples run."""

from __future__ import annotations

import doctest
import importlib
import inspect
from types import ModuleType
from typing import Any

import pytest

PACKAGES = ("noiseflow", "calibration", "recon")


def public() -> dict[str, Any]:
    """What the packages export, by its full name."""
    modules = [(package, importlib.import_module(package)) for package in PACKAGES]
    exports = {f"{package}.{name}": getattr(module, name) for package, module in modules for name in module.__all__}
    return {name: value for name, value in exports.items() if not isinstance(value, ModuleType)}


@pytest.mark.filterwarnings("ignore:.*(aligned images show|shifts images):UserWarning")  # examples of a few pixels
@pytest.mark.parametrize(("name", "value"), public().items(), ids=list(public()))
def test_every_public_name_has_an_example_that_runs(name: str, value: Any) -> None:
    example = doctest.DocTestParser().get_doctest(inspect.getdoc(value) or "", {}, name, None, 0)
    assert example.examples, "no example in the docstring"
    said: list[str] = []
    assert doctest.DocTestRunner().run(example, out=said.append).failed == 0, "".join(said)


def test_no_package_is_left_out() -> None:
    assert {name.split(".")[0] for name in public()} == set(PACKAGES)
