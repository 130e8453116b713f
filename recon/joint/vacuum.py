"""Rays that meet vacuum only: their pixels fix the signal without an object."""

import math

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor, nn

from noiseflow.checks import LIKELY
from noiseflow.statistics import weighted_line
from recon.fields.occupancy import Occupancy
from recon.joint.task import BATCH, Task
from recon.projection.base import to_columns
from recon.projection.image_formation import Linear, Transmission

# Of the level that may be vacuum in a coarse volume: a supporting film of a tenth of the scale is above it after some steps
_FAINT = 1 / 3
# Of the same level, where too few pixels are clear of that: objects that fill the field leave a haze, and without the level of
# vacuum their masses were 4 to 5 % too high (offset 291 of 300). The images must then exclude that the haze is matter. With at
# most 0.5, thin fibres with outliers had 1.37 times their mass; dim pieces beside bright ones keep theirs.
_HAZES, _MOST = (1, 3, 9), 1.0
_FEWEST = 400  # pixels: the level is then known to a twentieth of the noise, as well as free fits end at best


@torch.no_grad()
def vacuum_pixels(task: Task, least: float) -> Tensor | None:
    """Mask (tilt, u, y) of the pixels whose rays meet vacuum only.

    Positive volumes hold a haze of their noise, and a lower offset, or a stronger beam, makes room for it: of a gyroid with 40
    counts, the mass was 1.10 of the true one. Where rays pass nothing else, the images tell haze from vacuum, because rays
    through a film or through faint matter show more of it the longer their paths are. The haze counts as layers, which have
    few degrees of freedom: voxels were fitted to the noise of the same pixels.

    Args:
        task: the signal model after its first steps, and its pixels.
        least: attenuation, in units of the field's scale, below which a coarse volume may be vacuum.

    Returns:
        The mask; None if such pixels are few, if the haze is seen in the images, or if the level is known or differs by tilt.
    """
    model, response = task.signal_model, task.signal_model.image_formation
    if not isinstance(response, Transmission | Linear):
        return None
    if not response.vacuum.requires_grad or (isinstance(response, Linear) and response.vacuum.numel() > 1):
        return None
    volume, nothing = model.volume(), response(torch.zeros_like(task.observation))

    def lines(values: Tensor) -> Tensor:
        return model.projector.project(to_columns(values)).view(task.observation.shape)

    for faint in (each for each in (_FAINT, *_HAZES) if each * least < _MOST or each == _FAINT):
        matter = (
            Occupancy(volume / model.field.scale, volume.shape, least=faint * least).mask.transpose(1, 2).to(volume)
        )
        clear = (lines(matter) == 0) & task.train
        if int(clear.sum()) < _FEWEST:
            continue
        layers = (volume * (1 - matter)).sum((1, 2), keepdim=True) / (1 - matter).sum((1, 2), keepdim=True).clamp(min=1)
        path = response(lines(layers.expand_as(volume))) - nothing
        x, y = (each[clear].double().cpu().numpy() for each in (path, task.observation - nothing))
        line = weighted_line(x, y, np.ones(len(x)))
        chance = LIKELY * line.slope_error * math.sqrt(line.chi_squared)
        if line.slope >= chance:
            return None
        if faint == _FAINT or line.slope + chance < 1:
            return clear
    return None


@torch.no_grad()
def vacuum_level(noise_model: nn.Module, pixels: Tensor, unit: Tensor, lowest: float = -math.inf) -> float | None:
    """The most likely signal of pixels (P,), in `unit` (P,) of each; None if, as clipped, they do not determine it."""
    (values, units), counts = torch.unique(torch.stack([pixels, unit]), dim=1, return_counts=True)
    if len(values) > 2 * BATCH:
        values, units = (each[:: len(pixels) // BATCH] for each in (pixels, unit))
        counts = torch.ones_like(values)
    relative = (pixels / unit).double()
    mean, spread = float(relative.mean()), float(relative.std())
    low, high = max(lowest / float(unit.min()), mean - 2 * spread), mean + spread
    if not low < high:
        return None

    def cost(level: float) -> float:
        return -float(noise_model(level * units).log_prob(values).double() @ counts.double())

    tolerance = spread / _FEWEST
    found = float(minimize_scalar(cost, bounds=(low, high), options={"xatol": tolerance}).x)
    return found if min(found - low, high - found) > 2 * tolerance else None
