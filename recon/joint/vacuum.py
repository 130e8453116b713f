"""Detection of blocks of slices that contain only vacuum."""

from __future__ import annotations

import torch
from torch import nn

from noiseflow.distributions.image_pixels import needs_image
from recon.joint.task import Task


def stays_empty(task: Task, noise_model: nn.Module) -> bool:
    """Whether a block without occupied voxels would remain empty, so that fitting it is unnecessary.

    This is the test of `recon.fields.occupancy.Occupancy`: raising any block of voxels increases the likelihood by less than its
    total variation costs.

    Args:
        task: the task of the block, before any fit.
        noise_model: the noise model of the fit.
    """
    model = task.signal_model
    occupancy = model.occupancy
    if occupancy is None or bool(occupancy.mask.any()) or needs_image(noise_model):
        return False
    train = ~task.held_out if task.use is None else task.use & ~task.held_out
    num_train = max(1, int(train.sum()))
    lines = torch.zeros_like(task.observation, requires_grad=True)
    signal = model.image_formation(lines)
    slope = torch.empty_like(signal)
    for image, seen, use, result in zip(signal, task.observation, train, slope, strict=True):
        shown = image.detach().requires_grad_()  # one by one, because a likelihood needs much memory
        loss = -torch.where(use, noise_model(shown).log_prob(seen), 0.0).sum() / num_train
        (result[...],) = torch.autograd.grad(loss, shown)
    signal.backward(slope)
    gradient = lines.grad
    if gradient is None or not bool(torch.isfinite(gradient).all()):
        return False
    cost = model.weight / (float(model.field.scale) * model.num_pixels)
    return not bool(occupancy.wants(gradient.view(-1, model.field.height), model.projector, cost).any())
