"""Kullback–Leibler divergence between noise distributions for ``torch.distributions.kl_divergence``."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution, register_kl

from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.wrappers.numerical import as_noise_distribution


def _of_two(p: NoiseDistribution, q: NoiseDistribution) -> Tensor:
    """E_p[log p − log q], nats, by the quadrature rule of `p`."""
    if p.discrete != q.discrete:
        raise NotImplementedError(
            f"{type(p).__name__} and {type(q).__name__}: one is discrete and the other continuous; wrap the "
            "continuous one in Digitised with the rounding step of the discrete one"
        )

    def difference(observation: Tensor) -> Tensor:
        log_prob = p.log_prob(observation)
        # observations that are impossible under p contribute nothing
        return torch.where(torch.isneginf(log_prob), torch.zeros_like(log_prob), log_prob - q.log_prob(observation))

    return p.cast(p.expectation(difference))


def _of_ours(p: NoiseDistribution, q: Distribution) -> Tensor:
    return _of_two(p, as_noise_distribution(q))


def _of_theirs(p: Distribution, q: NoiseDistribution) -> Tensor:
    return _of_two(as_noise_distribution(p), q)


for _kinds, _divergence in (
    ((NoiseDistribution, NoiseDistribution), _of_two),
    ((NoiseDistribution, Distribution), _of_ours),
    ((Distribution, NoiseDistribution), _of_theirs),
):
    register_kl(*_kinds)(_divergence)  # type: ignore[no-untyped-call]
