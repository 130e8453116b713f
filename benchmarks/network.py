"""The coordinate network of Kniesel et al. (CVPR 2022), evaluated once on the whole voxel grid and projected to all tilts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from benchmarks.scenes import Scene
from noiseflow import Gaussian, fit
from recon.fields.kinds.network import DENSEST, PaperField
from recon.joint.signal_model import TomographySignal
from recon.joint.task import block_mask

WIDTHS = (32, 64, 128, 256)
_DENSITY_SCALE = 7.0
_STEPS = 300
_HIGHEST_RATE, _RATE_TIMES_WIDTH = 0.02, 1.28
_EMPTY = -4.0


def fit_network(
    scene: Scene,
    *,
    width: int,
    noise_model: Callable[[], nn.Module] | None = None,
    num_steps: int = _STEPS,
    seed: int = 0,
) -> NDArray[Any]:
    """Fit the network by least squares, then with a noise model if given; held-out pixels select the best step.

    Args:
        scene: the data and the device.
        width: width of the hidden layers.
        noise_model: function that creates a noise model to fit jointly with the volume.
        num_steps: full-batch steps of Adam; half of them by least squares if there is a noise model.
        seed: seed of all random choices.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        start = scene.joint(noise_model=Gaussian, seed=seed).signal_model(scene.noisy, scene.grid)
        scale = 2 * _DENSITY_SCALE / DENSEST / scene.grid.width
        field = PaperField(scene.grid.shape, width=width, scale=scale).to(scene.device)
        nn.init.constant_(field.network.last.bias, _EMPTY)  # type: ignore[union-attr, arg-type]
        field.relative_rate = 1.0  # the rates here are those of the network
        rate = min(_HIGHEST_RATE, _RATE_TIMES_WIDTH / width)
        model = TomographySignal(field, start.projector, start.image_formation, weight=0.0, learning_rate=rate)
        images = torch.from_numpy(np.ascontiguousarray(scene.noisy.images.transpose(0, 2, 1), dtype=np.float32)).to(
            scene.device
        )
        generator = torch.Generator().manual_seed(seed)
        held_out = block_mask(images.shape, generator=generator).to(scene.device)
        options: dict[str, Any] = {"held_out": held_out, "generator": generator, "digitise": False}
        first = num_steps if noise_model is None else math.ceil(num_steps / 2)
        fit(Gaussian().to(scene.device), model, images, num_steps=first, **options)
        if noise_model is not None:
            fit(
                noise_model().to(scene.device),
                model,
                images,
                num_steps=num_steps - first,
                learning_rate=0.03,
                **options,
            )
    return field.volume().cpu().numpy()
