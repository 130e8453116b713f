"""The examples in the docstrings of the public names run, and the names that people use most have one."""

from __future__ import annotations

import doctest
import importlib
import inspect
from types import ModuleType
from typing import Any

import pytest

WITH_EXAMPLE = {
    "noiseflow": "AtLevel DeadTimeCounter Digitised ExcessNoise Gaussian KnownSignal Mixture PhysicsFlow Poisson PoissonGaussian "
    "RadialFlow ScanNoise SignalDependentGaussian SplineFlow StaticScene WithMaps detect_digitisation fit load save select",
    "calibration": "align_pair read_pairs register",
    "recon": "SliceProjector TiltSeries VolumeGrid add_noise clean_tilt_series compare fourier_shell_correlation prepare "
    "read_tilt_series reconstruct sirt total_variation wbp",
}


def public(package: str) -> dict[str, Any]:
    module = importlib.import_module(package)
    return {name: getattr(module, name) for name in module.__all__ if not isinstance(getattr(module, name), ModuleType)}


def examples() -> list[tuple[str, str]]:
    """(name, docstring) of every public name that has an example."""
    found = []
    for package in WITH_EXAMPLE:
        for name, value in public(package).items():
            text = inspect.getdoc(value) or ""
            if ">>>" in text:
                found.append((f"{package}.{name}", text))
    return found


@pytest.mark.parametrize(("name", "text"), examples(), ids=[name for name, _ in examples()])
def test_examples_of_docstrings_run(name: str, text: str) -> None:
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, 0)
    said: list[str] = []
    assert doctest.DocTestRunner().run(test, out=said.append).failed == 0, "".join(said)


@pytest.mark.parametrize("package", WITH_EXAMPLE)
def test_names_in_common_use_have_an_example(package: str) -> None:
    have = {name.split(".")[1] for name, _ in examples() if name.startswith(f"{package}.")}
    assert not set(WITH_EXAMPLE[package].split()) - have
