"""Computations in steps with progress, interruption, checkpoints and resumption."""

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor


class Stage(Protocol):
    """A computation in steps.

    Attributes:
        done: completed steps.
        num_steps: total number of steps; a stage that finishes early reduces it.
    """

    done: int
    num_steps: int

    def step(self) -> str:
        """Take the next step. Return a short note, such as the current loss."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything that further steps depend on: nested dicts and lists of tensors, numbers and strings."""
        ...

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        ...


RunStage = Callable[[str, Stage], None]
"""``run_stage(title, stage)`` takes all remaining steps."""


def run_stage(title: str, stage: Stage) -> None:
    """Take all remaining steps; `recon.joint.checkpoint.Journal.run_stage` also reports progress and saves states."""
    del title
    while stage.done < stage.num_steps:
        stage.step()


class Repeated:
    """Repeated application of a function to a tensor.

    Args:
        advance: function from the tensor and the number of completed steps to the next tensor.
    """

    def __init__(self, start: Tensor, advance: Callable[[Tensor, int], Tensor], num_steps: int) -> None:
        self.value, self.advance, self.done, self.num_steps = start, advance, 0, num_steps

    def step(self) -> str:
        """Advance once."""
        self.value = self.advance(self.value, self.done)
        self.done += 1
        return ""

    def state(self) -> dict[str, Any]:
        """The tensor and the number of steps."""
        return {"value": self.value, "done": self.done}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore tensor and number of steps."""
        self.value, self.done = state["value"].to(self.value), state["done"]
