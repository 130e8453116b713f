"""Mean and variance of many tensors, seen one by one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Moments:
    """Running mean and sum of squared deviations (Welford 1962, doi:10.1080/00401706.1962.10490022).

    Args:
        like: a tensor of their shape.
    """

    def __init__(self, like: Tensor) -> None:
        self.count, self.mean, self.squares = 0, torch.zeros_like(like), torch.zeros_like(like)

    def add(self, value: Tensor) -> None:
        """Take one in."""
        self.count += 1
        before = value - self.mean
        self.mean.add_(before, alpha=1 / self.count)
        self.squares.addcmul_(before, value - self.mean)

    @property
    def std(self) -> Tensor:
        """Standard deviation; zero of fewer than two."""
        return (self.squares / max(1, self.count - 1)).sqrt()

    def state(self) -> dict[str, Any]:
        """What `load_state` takes."""
        return {"count": self.count, "mean": self.mean, "squares": self.squares}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.count = state["count"]
        self.mean, self.squares = (state[name].to(self.mean).clone() for name in ("mean", "squares"))
