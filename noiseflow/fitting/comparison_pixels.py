"""Training and validation pixels for the comparison of noise models, the same for every model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.arguments import as_mask, check_shapes, flat_like, in_single
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models.base import NoiseModelBase
from noiseflow.statistics import own_random

_JUDGING_AGAIN = 0.1  # share of the pixels for validation in the last fit of the chosen model


@dataclass(frozen=True)
class JudgedPixels:
    """Pixels with known signals, divided into training and validation pixels.

    Attributes:
        signal, observation: shaped as given, floating point.
        use, judge, judge_again: (N,) boolean: usable pixels, validation pixels, and the few of these that validate the last fit.
        blocks: (N,) block number of each pixel, or None if errors of pixels are independent.
    """

    signal: Tensor
    observation: Tensor
    use: Tensor
    judge: Tensor
    judge_again: Tensor
    blocks: Tensor | None

    @staticmethod
    def of(
        signal: Tensor,
        observation: Tensor,
        models: Sequence[NoiseModelBase],
        mask: Tensor | NDArray[np.bool_] | None,
        held_out: float | Tensor | NDArray[np.bool_],
        blocks: Tensor | NDArray[np.integer[Any]] | None,
        seed: int,
    ) -> JudgedPixels:
        """Divide the pixels by the mask `held_out` if it is one, otherwise at random by whole blocks or lines.

        Raises:
            ValueError: shapes differ, or there are no validation or too few training pixels.
        """
        check_shapes(signal=signal, observation=observation)
        use = as_mask(mask, observation).cpu()
        block = None if blocks is None else flat_like(blocks, observation, "blocks")
        group = _lines(observation.shape, models) if block is None else block.cpu()
        if np.ndim(held_out) == 0:
            draw = _drawn(group, observation.numel(), seed)
            judge, again = draw < float(held_out), draw < min(float(held_out), _JUDGING_AGAIN)
        else:
            judge = as_mask(held_out, observation, "held_out").cpu()
            again = judge & (_drawn(group, observation.numel(), seed) < 0.5)
        if not bool((use & judge).any()) or int((use & ~judge).sum()) < 2:
            raise ValueError(
                "held_out leaves no validation pixels or too few training pixels; give a fraction between 0 and 1"
            )
        use, judge, again = (each.to(observation.device) for each in (use, use & judge, use & again))
        return JudgedPixels(*in_single(signal, observation, use), use, judge, again, block)

    @property
    def num_judging(self) -> int:
        """Number of validation pixels."""
        return int(self.judge.sum())

    @property
    def judging_blocks(self) -> Tensor | None:
        """The block of each validation pixel."""
        return None if self.blocks is None else self.blocks[self.judge].cpu()

    def training(self, model: NoiseModelBase, *, most: int | None = None) -> dict[str, Any]:
        """Arguments of a fit of a model to the training pixels, or to about `most` of them."""
        train = self.use & ~self.judge
        if model.needs_image:
            return {"signal": self.signal, "observation": self.observation, "mask": train.reshape(self.signal.shape)}
        part = slice(None, None, 1 if most is None else max(1, int(train.sum()) // most))
        return {name: value.reshape(-1)[train][part] for name, value in self._values().items()}

    def everything(self, model: NoiseModelBase) -> dict[str, Any]:
        """Arguments of a fit of a model to all pixels except those that validate the last fit."""
        if model.needs_image:
            shape = self.signal.shape
            return self._values() | {"mask": self.use.reshape(shape), "held_out": self.judge_again.reshape(shape)}
        chosen = {name: value.reshape(-1)[self.use] for name, value in self._values().items()}
        return chosen | {"held_out": self.judge_again[self.use]}

    def _values(self) -> dict[str, Any]:
        return {"signal": self.signal, "observation": self.observation}

    @torch.no_grad()
    def score(self, model: NoiseModelBase, judge: Tensor | None = None) -> Tensor:
        """Log-likelihood of each validation pixel, float64, on the CPU."""
        judge = self.judge if judge is None else judge
        if not model.needs_image:
            found: Tensor = pixel_log_prob(model, *(value.reshape(-1)[judge] for value in self._values().values()))
            return found
        missing = ~judge.reshape(self.signal.shape)
        observation = (
            self.observation if model.shared_axis is None else self.observation.masked_fill(missing, torch.nan)
        )
        scores: Tensor = model(self.signal).log_prob(observation).reshape(-1)[judge].double().cpu()
        return scores


def _lines(shape: torch.Size, models: Sequence[NoiseModelBase]) -> Tensor | None:
    """The line of each pixel if pixels of a line share an offset under some model; None if pixels are independent."""
    axes = {model.shared_axis for model in models if model.needs_image}
    if not axes or len(shape) < 2:
        return None
    axis = next((each for each in axes if each is not None), -1)
    length = shape.numel() // shape[axis]
    moved = shape[:-1] if axis == -1 else torch.Size([*shape[:-2], shape[-1]])
    lines = torch.arange(length).reshape(moved)
    return lines.unsqueeze(axis).expand(shape).reshape(-1)


def _drawn(group: Tensor | None, count: int, seed: int) -> Tensor:
    """A uniform random number for each pixel, the same for all pixels of a group."""
    random = own_random(seed)
    if group is None:
        return torch.from_numpy(random.random(count))
    _, number = torch.unique(group, return_inverse=True)
    return torch.from_numpy(random.random(int(number.max()) + 1))[number]
