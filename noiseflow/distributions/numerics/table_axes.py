"""What tables of a likelihood, a function of two scalars, have in common: scale of signals, sizes, and a hash of the model."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

SIZES = [(64 << doubled, 1024 << doubled) for doubled in range(4)]
_LEAST_SHIFT, _MOST_SHIFT = 1e-6, 0.1
COARSE = 65


@dataclass(frozen=True)
class RootScale:
    """A scale of pixel values on which the noise has about constant width: √((value − low)/(high − low) + shift). Below `low` it
    continues linearly, because observations can be below every signal."""

    low: float
    high: float
    shift: float

    @staticmethod
    def of(noise_model: nn.Module, low: float, high: float, like: Tensor) -> RootScale:
        """The scale for signals from `low` to `high`, if the noise variance is linear between its values at the ends."""
        variance = variance_along(noise_model, low, high, like)
        least, most = float(variance.min()), float(variance.max())
        found = least / (most - least) if most > least else math.inf
        return RootScale(low, high, min(max(found, _LEAST_SHIFT), _MOST_SHIFT))

    @property
    def ends(self) -> tuple[float, float]:
        """Positions of `low` and `high` on the scale."""
        return self.shift**0.5, (1 + self.shift) ** 0.5

    def signal(self, signal: Tensor) -> Tensor:
        """Positions of signals inside the range."""
        scale = 1 / (self.high - self.low)
        return signal.mul(scale).add_(self.shift - self.low * scale).clamp_(min=self.shift).sqrt_()

    def observation(self, observation: Tensor) -> Tensor:
        """Positions of any pixel values."""
        share = ((observation - self.low) / (self.high - self.low)).clamp(max=0)
        root: Tensor = self.signal(observation) + share / (2 * self.shift**0.5)
        return root

    def inverse(self, root: Tensor) -> Tensor:
        """Pixel values at positions on the scale."""
        start = self.shift**0.5
        share = root.clamp(min=start) ** 2 - self.shift + 2 * start * (root - start).clamp(max=0)
        readings: Tensor = self.low + (self.high - self.low) * share
        return readings

    def slope(self, signal: Tensor) -> Tensor:
        """Derivative of the scale with respect to the signal."""
        return 0.5 / ((self.high - self.low) * self.signal(signal))


def variance_along(noise_model: nn.Module, low: float, high: float, like: Tensor) -> Tensor:
    """The variance of the noise at 65 equally spaced signals."""
    coarse = torch.linspace(low, high, COARSE, dtype=like.dtype, device=like.device)
    variance: Tensor = getattr(noise_model, "model", noise_model)(coarse).variance.detach()
    return variance


_PLAIN = (bool, int, float, str, type(None))


@torch.no_grad()
def fingerprint(model: nn.Module) -> str:
    """Hash all parameters and buffers with their data types and devices, and the plain settings of all submodules."""
    digest = hashlib.blake2b(digest_size=16)
    for name, tensor in (*model.named_parameters(), *model.named_buffers()):
        digest.update(f"{name}{tuple(tensor.shape)}{tensor.dtype}{tensor.device}".encode())
        digest.update(_bytes(tensor))
    for name, module in model.named_modules():
        settings = {key: value for key, value in vars(module).items() if not key.startswith("_")}
        plain = {key: value for key, value in settings.items() if isinstance(value, _PLAIN)}
        digest.update(f"{name}{type(module).__qualname__}{sorted(plain.items(), key=str)}".encode())
        for key, value in settings.items():
            if isinstance(value, (Tensor, np.ndarray)):
                digest.update(key.encode() + _bytes(torch.as_tensor(value)))
    return digest.hexdigest()


def _bytes(tensor: Tensor) -> Any:
    return tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data if tensor.numel() else b""
