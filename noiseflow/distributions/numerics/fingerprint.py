"""A hash that identifies the parameters of a model by their contents, however they were changed."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

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
