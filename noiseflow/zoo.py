"""Fitted noise models of real detectors, shipped with the library.

`names` lists them, `load` returns one, and `describe` tells what it was fitted to: the data and their licence, the range of
signals, the known deviations, and statistics of the data by signal level.
"""

import json
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import nn

from noiseflow.io import model_files

FOLDER = Path(__file__).parent / "data" / "zoo"


def names() -> list[str]:
    """Names of the shipped models."""
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def load(name: str) -> nn.Module:
    """A fitted noise model, in the units of its detector.

    Raises:
        ValueError: the name is unknown.

    Example:
        >>> import noiseflow, torch
        >>> camera = noiseflow.zoo.load("miro-scmos")
        >>> with torch.no_grad():
        ...     round(camera(torch.tensor(200.0)).mean.item(), -1)
        200.0
    """
    return model_files.load(_path(name))


def describe(name: str) -> dict[str, Any]:
    """What a model was fitted to.

    Returns:
        ``detector``, ``source`` (repository and licence), ``fitted_to``, ``deviations``, ``units``, ``kind``, and
        ``statistics``: for levels of the signal, the number of pixels and the mean, standard deviation, skewness and quantiles of
        observation minus signal in the data.

    Raises:
        ValueError: the name is unknown.
    """
    with safe_open(_path(name), framework="np") as file:
        found = file.metadata()
    about: dict[str, Any] = json.loads(found["provenance"])
    return about | {"kind": json.loads(found["model"])["kind"], "units": found["units"]}


def _path(name: str) -> Path:
    if name not in names():
        raise ValueError(f"the zoo has no model {name!r}; choose one of {', '.join(names())}")
    return FOLDER / f"{name}.safetensors"
