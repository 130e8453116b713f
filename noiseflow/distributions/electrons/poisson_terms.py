"""Poisson terms of the distribution of electrons plus read noise, and the position of the largest."""

from __future__ import annotations

import torch
from torch import Tensor

from noiseflow.distributions.electrons.contour import poisson_normal_mode, positive_rate

REACH = 6.5  # half-width of the sum over electrons, in standard deviations: omits 1e-10, less than the quadrature error 3e-7


def log_poisson(count: Tensor, rate: Tensor) -> Tensor:
    """log P(k = count), with the leading terms of Stirling's formula paired with the rate to avoid cancellation."""
    positive, safe = positive_rate(rate)
    shifted = count + 0.5
    u = (shifted - safe) / safe
    at = count.clamp(max=1e7)  # above this, the remainder changes by less than 1e-8
    remainder = torch.lgamma(at + 1) - (at + 0.5) * (torch.log(at + 0.5) - 1)
    deviance = safe * ((1 + u) * torch.log1p(u) - u)
    none = torch.where(count > 0, torch.full_like(rate, -1e300), -rate)
    return torch.where(positive, -deviance - 0.5 * torch.log(safe) - remainder, none)


def lattice_mode(residual: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.round((poisson_normal_mode(rate + residual + 0.5, rate, variance) - 0.5).clamp(min=0))
