"""Work in steps that can be watched, stopped between two of them, kept, and gone on with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor


class Stage(Protocol):
    """Work in steps.

    Attributes:
        done: steps taken.
        num_steps: of all; a stage that is finished early lowers it.
    """

    done: int
    num_steps: int

    def step(self) -> str:
        """Take the next step; returns a few words such as the present loss."""
        ...

    def state(self) -> dict[str, Any]:
        """All that the steps to come depend on: nested dicts and lists of tensors, numbers and strings."""
        ...

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        ...


RunStage = Callable[[str, Stage], None]
"""``run_stage(title, stage)`` takes all the steps that are left."""


def run_stage(title: str, stage: Stage) -> None:
    """Take all the steps that are left; `recon.joint.checkpoint.Journal.run_stage` also tells of them and keeps them."""
    del title
    while stage.done < stage.num_steps:
        stage.step()


class Repeated:
    """A tensor that becomes the next one at every step.

    Args:
        start: the tensor to begin with.
        advance: from the tensor and the number of steps done to the next tensor.
        num_steps: how often.
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
        """Go on from there."""
        self.value, self.done = state["value"].to(self.value), state["done"]
