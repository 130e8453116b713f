"""Training and validation pixels: of a fit, chosen singly or in whole lines, and of a comparison, the same for every model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.arguments import as_mask, check_shapes, flat_like, require_finite, resolved_in_single
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models.at_level import above, level_of
from noiseflow.models.base import NoiseModelBase
from noiseflow.statistics import ENOUGH, own_random

_TOO_FEW = (
    "{} usable {} are too few to fit and validate a noise model if held_out selects {}; use more, or select others"
)

JUDGED_LAST = 100_000
"""Held-out pixels that measure the likelihood of a finished fit."""


@dataclass(frozen=True)
class FitPixels:
    """The pixels of a fit.

    Attributes:
        observation: (N,) pixel values; unusable ones are replaced by a finite number, or by NaN if lines are fitted.
        train, judge: indices of training and validation pixels, (P,), or of lines of pixels, (P, L).
        weight: (N,) weight of each pixel in a full-batch loss.
    """

    observation: Tensor
    shape: torch.Size
    train: Tensor
    judge: Tensor
    weight: Tensor
    generator: torch.Generator

    @staticmethod
    def choose(observation: Tensor, use: Tensor, held_out: float | Tensor, generator: torch.Generator) -> FitPixels:
        """Divide the usable pixels, `use` (N,), of observations of any shape. Raises ValueError if too few are usable."""
        judge = _drawn(use, held_out, generator)
        train, judging = (torch.nonzero(chosen).squeeze(1) for chosen in (use & ~judge, use & judge))
        if train.numel() < 2 or judging.numel() < 1:
            raise ValueError(_TOO_FEW.format(int(use.sum()), "pixels", judging.numel()))
        flat = observation.reshape(-1)
        bad = ~torch.isfinite(flat)
        if bool(bad.any()):  # unused pixels have weight 0, but 0·NaN would make the sum NaN
            flat = torch.where(bad, flat[use].mean(), flat)
        weight = (use & ~judge).to(flat.dtype) / train.numel()
        return FitPixels(flat, observation.shape, train, judging, weight, generator)

    @staticmethod
    def choose_lines(
        observation: Tensor, use: Tensor, held_out: float | Tensor, generator: torch.Generator, *, axis: int
    ) -> FitPixels:
        """Divide whole rows (axis −1) or columns (−2) of images. A mask `held_out` selects lines of which it covers most. Raises
        ValueError if there are too few lines."""
        lines = torch.arange(observation.numel(), device=use.device).reshape(observation.shape).movedim(axis, -1)
        lines = lines.reshape(-1, observation.shape[axis])
        lines = lines[use[lines].any(1)]
        if isinstance(held_out, Tensor):
            judge = held_out.reshape(-1)[lines].float().mean(1) > 0.5
        else:
            judge = _drawn(torch.ones(len(lines), dtype=torch.bool, device=use.device), held_out, generator)
        train, judging = lines[~judge], lines[judge]
        if len(train) < 2 or len(judging) < 1:
            raise ValueError(_TOO_FEW.format(len(lines), "rows or columns", len(judging)))
        flat = torch.where(use, observation.reshape(-1), math.nan)
        return FitPixels(flat, observation.shape, train, judging, torch.zeros_like(flat), generator)

    def repeated(self, weight: Tensor) -> FitPixels:
        """The same pixels, repeated in proportion to (N,) weights: exactly if these are whole multiples of the least one, else
        rounded so that errors cancel along the pixels."""

        def copies(pixels: Tensor) -> Tensor:
            share = weight[pixels]
            most = min(float(share.sum() / share.min()), max(ENOUGH, pixels.numel()))
            ends = torch.cumsum(share / share.sum(), 0) * most
            return pixels.repeat_interleave(torch.round(ends).long().diff(prepend=torch.zeros_like(pixels[:1])))

        return replace(self, train=copies(self.train), judge=copies(self.judge))

    @property
    def image(self) -> tuple[int, int]:
        """Height and width of each image."""
        return self.shape[-2], self.shape[-1]

    def batch(self, size: int) -> Tensor:
        """About `size` training pixels, or lines with as many pixels, drawn at random."""
        count = min(size, self.train.numel()) * len(self.train) // self.train.numel()
        draw = torch.randint(len(self.train), (max(1, count),), generator=self.generator)
        return self.train[draw.to(self.train.device)]


def _drawn(use: Tensor, held_out: float | Tensor, generator: torch.Generator) -> Tensor:
    if isinstance(held_out, Tensor):
        return held_out.reshape(-1).bool()
    return (torch.rand(use.shape, generator=generator) < held_out).to(use.device)


def thinned(pixels: Tensor, most: int) -> Tensor:
    """At most `most` pixels, evenly selected from pixels (P,) or lines (P, L)."""
    return pixels[:: max(1, -(-pixels.numel() // most))]


@dataclass(frozen=True)
class JudgedPixels:
    """Pixels with known signals, divided into training and validation pixels.

    Attributes:
        signal, observation: above `level`, shaped as given, floating point.
        use, judge, judge_again: (N,) boolean: usable pixels, validation pixels, and the few of these that validate the last fit.
        blocks: (N,) block number of each pixel, or None if errors of pixels are independent.
        level: what was subtracted, because single precision does not resolve the noise there.
    """

    signal: Tensor
    observation: Tensor
    use: Tensor
    judge: Tensor
    judge_again: Tensor
    blocks: Tensor | None
    level: float

    @staticmethod
    def of(
        signal: Tensor,
        observation: Tensor,
        models: Sequence[NoiseModelBase],
        mask: Tensor | NDArray[np.bool_] | None,
        held_out: float | Tensor | NDArray[np.bool_],
        blocks: Tensor | NDArray[np.integer[Any]] | None,
        seed: int,
        *,
        again: float = 0.1,
    ) -> JudgedPixels:
        """Divide the pixels by the mask `held_out` if it is one, otherwise at random by whole blocks or lines. A share of at most
        `again` validates the last fit of the chosen model. Raises ValueError
        if shapes differ, or there are no validation or too few training pixels."""
        check_shapes(signal=signal, observation=observation)
        use = as_mask(mask, observation).cpu()
        require_finite((torch.isfinite(signal) & torch.isfinite(observation)).cpu().reshape(-1)[use], "a mask")
        block = None if blocks is None else flat_like(blocks, observation, "blocks")
        group = _lines(observation.shape, models) if block is None else block.cpu()
        if np.ndim(held_out) == 0:
            draw = _random_by_group(group, observation.numel(), seed)
            judge, few = draw < float(held_out), draw < min(float(held_out), again)
        else:
            judge = as_mask(held_out, observation, "held_out").cpu()
            few = judge & (_random_by_group(group, observation.numel(), seed) < 0.5)
        if not bool((use & judge).any()) or int((use & ~judge).sum()) < 2:
            raise ValueError("held_out leaves too few validation or training pixels; give a fraction between 0 and 1")
        use, judge, few = (each.to(observation.device) for each in (use, use & judge, use & few))
        level = level_of(signal.reshape(-1)[use], observation.reshape(-1)[use], models)
        signal, observation = above(level, signal, observation)
        single = resolved_in_single(signal.reshape(-1)[use], observation.reshape(-1)[use])
        signal, observation = (each.to(torch.float32 if single else torch.float64) for each in (signal, observation))
        return JudgedPixels(signal, observation, use, judge, few, block, level)

    def at_most(self, most: int, models: Sequence[NoiseModelBase], seed: int) -> JudgedPixels:
        """At most about so many training and validation pixels each, drawn at random, by whole lines if any model needs them."""
        draw = _random_by_group(_lines(self.signal.shape, models), self.use.numel(), seed).to(self.use.device)
        part = draw * torch.where(self.judge, self.judge.sum(), (self.use & ~self.judge).sum()) <= most
        return replace(self, use=self.use & part, judge=self.judge & part, judge_again=self.judge_again & part)

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
        observation = self.observation
        if model.shared_axis is not None:
            observation = observation.masked_fill(~judge.reshape(observation.shape), torch.nan)
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
    return torch.arange(length).reshape(moved).unsqueeze(axis).expand(shape).reshape(-1)


def _random_by_group(group: Tensor | None, count: int, seed: int) -> Tensor:
    """A uniform random number for each pixel, the same for all pixels of a group."""
    random = own_random(seed)
    if group is None:
        return torch.from_numpy(random.random(count))
    _, number = torch.unique(group, return_inverse=True)
    return torch.from_numpy(random.random(int(number.max()) + 1))[number]
