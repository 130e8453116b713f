"""Look-up of regularisers by name."""

from __future__ import annotations

from importlib import import_module

from noiseflow.plugins import load_plugin, plugins
from recon.fields.regularisers._names import GROUP, regulariser_names
from recon.fields.regularisers.base import Regulariser


def find_regulariser(name: str) -> Regulariser:
    """Create the regulariser with a given name, with its default settings.

    Raises:
        ValueError: the name is unknown.
        TypeError: the entry point with that name does not create a regulariser.
    """
    if name not in regulariser_names():
        raise ValueError(f"--regulariser {name}: choose one of {', '.join(regulariser_names())}")
    other = plugins(GROUP).get(name)
    own = f"recon.fields.regularisers.{name.replace('-', '_')}"
    made = import_module(own).REGULARISER() if other is None else load_plugin(other)()
    if not isinstance(made, Regulariser):
        raise TypeError(
            f"regulariser {name} is a {type(made).__name__}; derive it from recon.fields.regularisers.Regulariser"
        )
    return made
