"""Distances between probability vectors, and between a sample and the uniform distribution."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from noiseflow.arguments import real

# Rounding errors of the sum of a million probabilities in single precision.
_ROUNDING = 1e-4


def jensen_shannon(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Jensen–Shannon divergence in nats between probability vectors along the last axis (Lin 1991, doi:10.1109/18.61115).

    Raises:
        ValueError: entries are negative or not finite, vectors do not sum to 1, or their lengths differ.
    """
    p, q = _probabilities(p, q)
    middle = (p + q) / 2
    return np.asarray((_relative_entropy(p, middle) + _relative_entropy(q, middle)) / 2)


def bhattacharyya(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Bhattacharyya coefficient Σ√(pq) along the last axis; the Bhattacharyya distance is its negative logarithm.

    Raises:
        ValueError: as `jensen_shannon`.
    """
    p, q = _probabilities(p, q)
    return np.asarray(np.sqrt(p * q).sum(-1))


def _probabilities(*given: ArrayLike) -> list[NDArray[np.float64]]:
    found = [real(each, "a histogram").double().cpu().numpy() for each in given]
    try:
        whole = np.broadcast_shapes(*(each.shape for each in found))
    except ValueError:
        whole = ()
    if not whole or any(each.shape[-1:] != whole[-1:] for each in found):
        raise ValueError(f"shapes {[each.shape for each in found]} do not agree; give vectors of equally many bins")
    for each in found:
        if not (np.isfinite(each).all() and (each >= 0).all()):
            raise ValueError("some probabilities are negative, NaN or infinite; give a histogram's shares")
        if np.abs(each.sum(-1) - 1).max(initial=0) > _ROUNDING:
            raise ValueError("some probabilities do not sum to 1; divide counts by their sum")
    return found


def _relative_entropy(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    p, q = np.broadcast_arrays(p, q)
    ratio = np.divide(p, q, out=np.ones_like(p), where=p > 0)
    return np.asarray((p * np.log(ratio)).sum(-1))


def kolmogorov_smirnov(u: ArrayLike) -> float:
    """Largest distance between the empirical CDF of `u` and the uniform one.

    Raises:
        ValueError: there are no values, or some are outside [0, 1] or NaN.
    """
    ordered = np.sort(np.asarray(u, dtype=np.float64).ravel())
    if not ordered.size or not (ordered[0] >= 0 and ordered[-1] <= 1):  # NaN sorts last
        raise ValueError(
            "there are no values, or some are outside [0, 1] or NaN; give a probability integral transform"
        )
    steps = np.arange(ordered.size + 1) / ordered.size
    return float(max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max()))
