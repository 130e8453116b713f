"""A signal model with the pixels that it is fitted to and those that judge it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from noiseflow.fitting.observation_table import TableKeeper
from recon.joint.half_resolution import HalfResolution
from recon.joint.signal_model import TomographySignal


@dataclass
class Task:
    """A signal model and its pixels.

    Attributes:
        signal_model: what is fitted.
        observation: (tilt, u, y) pixel values, detector units.
        use: (tilt, u, y) False at pixels that are left out; None uses all.
        held_out: (tilt, u, y) True at pixels that judge and never train.
    """

    signal_model: TomographySignal
    observation: Tensor
    use: Tensor | None
    held_out: Tensor
    _tables: dict[nn.Module, TableKeeper] = field(default_factory=dict)

    def tables(self, noise_model: nn.Module) -> TableKeeper:
        """The table of the pixels under a noise model, kept until the model changes."""
        return self._tables.setdefault(noise_model, TableKeeper())

    def forget(self, noise_model: nn.Module) -> None:
        """Let go of the table of a noise model that has changed."""
        self._tables.pop(noise_model, None)

    @torch.no_grad()
    def signal(self) -> Tensor:
        """The signal of all pixels as it is, (tilt, u, y)."""
        return self.signal_model.signal().view_as(self.observation)

    @contextmanager
    def halved(self) -> Iterator[Task]:
        """The same task at half the resolution; what it learns, this one has learnt."""
        half = HalfResolution(self.signal_model)
        use = None if self.use is None else half.pixels(self.use)
        yield Task(half.signal_model, half.pixels(self.observation), use, half.pixels(self.held_out))
        half.hand_over()


def block_mask(shape: tuple[int, ...], *, share: float = 0.1, block: int = 4, generator: torch.Generator) -> Tensor:
    """Pixels (tilt, u, y) to hold out: whole blocks in every image, so that neighbours do not give them away."""
    tilts, *sides = shape
    coarse = torch.rand((tilts, *(-(-side // block) for side in sides)), generator=generator) < share
    return coarse.repeat_interleave(block, 1).repeat_interleave(block, 2)[:, : sides[0], : sides[1]]
