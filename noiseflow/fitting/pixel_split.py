"""Training and validation pixels of a fit, chosen singly or in whole lines."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

_TOO_FEW = (
    "{} usable {} are too few to fit and validate a noise model if held_out selects {}; use more, or select others"
)

STANDARDISED = 1_000_000
"""Pixels that suffice to measure the scaling of a noise model, and the most copies of weighted pixels."""
JUDGED_LAST = 100_000
"""Held-out pixels that measure the likelihood of a finished fit."""


@dataclass(frozen=True)
class FitPixels:
    """The pixels of a fit.

    Attributes:
        observation: (N,) pixel values; unusable ones are replaced by a finite number, or by NaN if lines are fitted.
        shape: shape of the images.
        train, judge: indices of training and validation pixels, (P,), or of lines of pixels, (P, L).
        weight: (N,) weight of each pixel in a full-batch loss.
        generator: source of the random choices.
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
        """Divide whole rows (axis −1) or columns (−2) of images. A mask `held_out` selects lines of which it covers most.

        Raises:
            ValueError: too few lines.
        """
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
            most = min(float(share.sum() / share.min()), max(STANDARDISED, pixels.numel()))
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
