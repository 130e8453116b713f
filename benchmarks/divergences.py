"""The divergence of noise models from a known truth, by draws."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.fitting.stream import judged_pixels
from noiseflow.metrics.evaluation import pixel_log_prob


@torch.no_grad()
def kl_divergence(truth: nn.Module, noise_model: nn.Module, signal: Tensor, *, seed: int = 0) -> tuple[float, float]:
    """E[log p_true − log p_model] and its standard error, nats per pixel, of one draw for each of (N,) signals."""
    signal, _ = judged_pixels(signal, signal)
    generator = torch.Generator(signal.device).manual_seed(seed)
    observation = as_noise_distribution(truth(signal)).sample(generator=generator)
    difference = pixel_log_prob(truth, signal, observation) - pixel_log_prob(noise_model, signal, observation)
    return float(difference.mean()), float(difference.std(correction=0)) / math.sqrt(difference.numel())
