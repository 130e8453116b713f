"""Look-up of regularisers by name."""

from __future__ import annotations

from noiseflow.plugins import provided
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
    made = provided(name, "recon.fields.regularisers", GROUP, "REGULARISER")()
    if not isinstance(made, Regulariser):
        raise TypeError(
            f"regulariser {name} is a {type(made).__name__}; derive it from recon.fields.regularisers.Regulariser"
        )
    return made
