"""The running average of a model's weights, and which of the states of a fit to keep."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

_DECAY, _START = 0.98, 10


class WeightAverage:
    """Exponential average of the weights over about the last fifty steps (Polyak & Juditsky 1992, doi:10.1137/0330046).

    Single steps jitter about the most likely weights, and the looks at held-out pixels would pick among that jitter; their
    average does not, and is as good after a fifth of the steps as the last weights at the end.

    Args:
        model: whose trainable weights are averaged.
    """

    def __init__(self, model: nn.Module) -> None:
        self._weights = [p for p in model.parameters() if p.requires_grad]
        self.restart()

    @torch.no_grad()
    def restart(self) -> None:
        """Begin again from the weights as they are."""
        self._average = [weight.detach().clone() for weight in self._weights]
        self._count = 0

    @torch.no_grad()
    def update(self) -> None:
        """Take in the weights as they are."""
        self._count += 1
        share = 1 - min(_DECAY, self._count / (self._count + _START))
        for average, weight in zip(self._average, self._weights, strict=True):
            average.lerp_(weight, share)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The model with the average for its weights, while it lasts."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        for average, weight in zip(self._average, self._weights, strict=True):
            kept = weight.clone()
            weight.copy_(average)
            average.copy_(kept)

    def state(self) -> dict[str, Any]:
        """What `load_state` takes."""
        return {"average": [average.clone() for average in self._average], "count": self._count}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that `state` returned."""
        self._average, self._count = [average.clone() for average in state["average"]], state["count"]


class BestState:
    """The state to end at: the latest one that no earlier one beats beyond chance on the held-out pixels, or, `strict`, the best.

    A start that is the best of all is kept: then there is nothing to learn. Where looks are strict, it must be so beyond chance:
    a signal comes from a fit to other noise, and steps that end at a small rate are worth more than a look that tells nothing.
    """

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self._scores: Tensor | None = None
        self._start_leads = True

    def judge(self, state: dict[str, Any], scores: Tensor, *, start: bool, strict: bool) -> bool:
        """Take a state with its log-likelihoods of the held-out pixels, (P,); whether it is now the one to end at."""
        if self._scores is None:
            self._scores, self._start_leads, self.state = scores, start, state
            return True
        behind = self._scores - scores
        error = float(behind.std(correction=0)) / math.sqrt(behind.numel())
        leads = not float(behind.mean()) > 0
        if not leads and (self._start_leads != strict or float(behind.mean()) > error):
            return False
        if leads:
            self._scores, self._start_leads = scores, False
        self.state = state
        return True

    def saved(self) -> dict[str, Any]:
        """What `load` takes."""
        return {"state": self.state, "scores": self._scores, "start_leads": self._start_leads}

    def load(self, saved: dict[str, Any]) -> None:
        """Go on from what `saved` returned."""
        self.state, self._scores, self._start_leads = saved["state"], saved["scores"], saved["start_leads"]
