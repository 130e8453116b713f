"""Running mean and variance of tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Moments:
    """Running mean and sum of squared deviations (Welford 1962, doi:10.1080/00401706.1962.10490022).

    Args:
        like: a tensor of the same shape.
    """

    def __init__(self, like: Tensor) -> None:
        self.count, self.mean, self.squares = 0, torch.zeros_like(like), torch.zeros_like(like)

    def add(self, value: Tensor) -> None:
        """Add a value."""
        self.count += 1
        before = value - self.mean
        self.mean.add_(before, alpha=1 / self.count)
        self.squares.addcmul_(before, value - self.mean)

    @property
    def std(self) -> Tensor:
        """Standard deviation; zero for fewer than two values."""
        return (self.squares / max(1, self.count - 1)).sqrt()

    def state(self) -> dict[str, Any]:
        """The state for `load_state`."""
        return {"count": self.count, "mean": self.mean, "squares": self.squares}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.count = state["count"]
        self.mean, self.squares = (state[name].to(self.mean).clone() for name in ("mean", "squares"))
