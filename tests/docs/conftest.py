"""Fixtures for tests of the documentation."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def example(request: pytest.FixtureRequest) -> ModuleType:
    """The program of ``docs/examples`` whose name the test module has."""
    name = request.module.__name__.rpartition("test_")[2]
    file = Path(__file__).parents[2] / "docs" / "examples" / f"{name}.py"
    specification = importlib.util.spec_from_file_location(name, file)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
