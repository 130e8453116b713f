"""Distances between probability vectors, and between a sample and the uniform distribution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def jensen_shannon(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jensen–Shannon divergence in nats between probability vectors along the last axis (Lin 1991, doi:10.1109/18.61115)."""
    middle = (p + q) / 2
    return np.asarray((_relative_entropy(p, middle) + _relative_entropy(q, middle)) / 2)


def bhattacharyya(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bhattacharyya coefficient Σ√(pq) along the last axis; the Bhattacharyya distance is its negative logarithm."""
    return np.asarray(np.sqrt(p * q).sum(-1))


def _relative_entropy(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    p, q = np.broadcast_arrays(p, q)
    ratio = np.divide(p, q, out=np.ones_like(p), where=p > 0)
    return np.asarray((p * np.log(ratio)).sum(-1))


def kolmogorov_smirnov(u: NDArray[np.float64]) -> float:
    """Largest distance between the empirical CDF of `u` and the uniform one."""
    ordered = np.sort(u)
    steps = np.arange(u.size + 1) / u.size
    return float(max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max()))
