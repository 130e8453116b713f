"""Regularisers on trial: written for brevity, differentiated by torch, and not part of the package."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from torch import Tensor
from torch.nn.functional import avg_pool3d

from benchmarks.pages.prior_denoisers import Denoiser, non_local_means, phantom_network, tilt_network
from benchmarks.scenes import Scene
from recon.fields.regularisers import DirectionalVariation, Regulariser, SecondOrderVariation, TotalVariation

_SMOOTHING = 0.02  # as of total variation
_PAIRS = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


def _squares(volume: Tensor, along_z: float = 1.0) -> Tensor:
    """Squared gradient of (z, x, y), its z part weighted."""
    total = torch.zeros_like(volume)
    for axis, factor in enumerate((along_z, 1.0, 1.0)):
        size = volume.shape[axis]
        step = torch.diff(volume, dim=axis, append=volume.narrow(axis, size - 1, 1))
        total = total + (factor * step) ** 2
    return total


class GroupSparsity(Regulariser):
    """Jumps count together with those of their neighbours, 2³ voxels that overlap (doi:10.1007/s10915-013-9736-1)."""

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        together = avg_pool3d(_squares(volume)[None, None], 2, stride=1)
        smoothing = _SMOOTHING * scale
        return ((together + smoothing**2).sqrt() - smoothing).sum()


class FlatterAlongBeam(Regulariser):
    """Total variation whose differences along z, which few tilts saw, count `along_z` times."""

    def __init__(self, along_z: float) -> None:
        self.along_z = along_z

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        smoothing = _SMOOTHING * scale
        return ((_squares(volume, self.along_z) + smoothing**2).sqrt() - smoothing).sum()


class WithAttenuation(Regulariser):
    """Total variation and a share of the sum of attenuation, which is never negative."""

    def __init__(self, share: float) -> None:
        self.share, self.variation = share, TotalVariation()

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        return self.variation(volume, scale) + self.share * volume.sum()


def _gradient(volume: Tensor) -> Tensor:
    """Forward differences, (3, z, x, y), zero at the end of each axis."""
    return torch.stack([_difference(volume, axis) for axis in range(3)])


def _difference(volume: Tensor, axis: int) -> Tensor:
    return torch.diff(volume, dim=axis, append=volume.narrow(axis, volume.shape[axis] - 1, 1))


def _adjoint(flow: Tensor, axis: int) -> Tensor:
    inner = flow.narrow(axis, 0, flow.shape[axis] - 1)
    found = torch.zeros_like(flow)
    found.narrow(axis, 0, inner.shape[axis]).sub_(inner)
    found.narrow(axis, 1, inner.shape[axis]).add_(inner)
    return found


def _size(squared: Tensor, smoothing: float) -> Tensor:
    return (squared + smoothing**2).sqrt() - smoothing


def _blurred(volume: Tensor) -> Tensor:
    """Means of 3³ voxels."""
    return avg_pool3d(volume[None, None], 3, 1, 1, count_include_pad=False)[0, 0]


class Schatten(Regulariser):
    """Sum of the sizes of the Hessian's eigenvalues (doi:10.1109/TIP.2013.2237919), halved so that a flat step costs its jump;
    `share` of it, the rest is total variation."""

    def __init__(self, share: float) -> None:
        self.share, self.variation = share, TotalVariation()

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        hessian = _hessian(volume / scale)
        hessian = hessian[(hessian.detach().abs().amax((1, 2)) > 1e-6).nonzero()[:, 0]]  # vacuum costs nothing
        value, slope = _nuclear(hessian.detach().double(), _SMOOTHING)
        tangent = (slope.to(hessian) * hessian).sum()
        cost = (tangent + (value - tangent).detach()) * scale / 2
        return self.share * cost + (1 - self.share) * self.variation(volume, scale)


def _hessian(volume: Tensor) -> Tensor:
    """(N, 3, 3), centred on the diagonal, where it is zero at the edges."""
    slopes, found = _gradient(volume), {}
    for first, second in _PAIRS:
        if first == second:
            inner = torch.diff(volume, n=2, dim=first)
            edge = torch.zeros_like(volume.narrow(first, 0, 1))
            found[first, first] = torch.cat([edge, inner, edge], first)
        else:
            found[first, second] = found[second, first] = _difference(slopes[first], second)
    rows = [torch.stack([found[row, column] for column in range(3)], -1) for row in range(3)]
    return torch.stack(rows, -2).reshape(-1, 3, 3)


def _nuclear(matrix: Tensor, smoothing: float) -> tuple[Tensor, Tensor]:
    """Σ √(λ² + ε²) − ε over the eigenvalues of symmetric (N, 3, 3), and its derivative M (M² + ε²)^(-1/2): the root by its
    invariants, which no two equal eigenvalues trouble."""
    one = torch.eye(3, dtype=matrix.dtype)
    square = matrix @ matrix + smoothing**2 * one
    mean = square.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    spread = (((square - mean * one) ** 2).sum((1, 2), keepdim=True) / 6).sqrt().clamp_min(1e-12)
    angle = torch.acos((torch.linalg.det((square - mean * one) / spread) / 2).clamp(-1, 1))[:, None] / 3
    turns = torch.arange(3) * (2 * math.pi / 3)
    roots = (mean[:, 0] + 2 * spread[:, 0] * torch.cos(angle + turns)).clamp_min(smoothing**2).sqrt()
    trace, determinant = roots.sum(1)[:, None, None], roots.prod(1)[:, None, None]
    minors = (roots * roots.roll(1, 1)).sum(1)[:, None, None]
    product = trace * minors - determinant
    root = (trace * determinant * one + (trace**2 - minors) * square - square @ square) / product
    inverse = (square - trace * root + minors * one) / determinant
    return (roots - smoothing).sum(), matrix @ inverse


class GeneralisedVariation(Regulariser):
    """Total generalised variation of second order (doi:10.1137/090769521): min over w of Σ|∇v − w| + β Σ|ℰw|. The slope w is
    kept, and a few primal-dual steps of it (doi:10.1007/s10851-010-0251-1) are taken for each of the volume."""

    _STEP = 0.04  # of w, in units of the scale; that of its dual follows, for ‖ℰ‖² ≤ 12

    def __init__(self, beta: float, *, num_steps: int = 2) -> None:
        self.beta, self.num_steps = beta, num_steps
        self.slope: Tensor | None = None

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        gradient = _gradient(volume) / scale
        with torch.no_grad():
            slope = self._improved(gradient.detach())
            bends = self.beta * _size((_bends(slope) ** 2).sum(0), _SMOOTHING).sum()
        return scale * (_size(((gradient - slope) ** 2).sum(0), _SMOOTHING).sum() + bends)

    def _improved(self, gradient: Tensor) -> Tensor:
        if self.slope is None:
            self.slope = self.ahead = torch.zeros_like(gradient)
            self.dual = _bends(self.slope)
        for _ in range(self.num_steps):
            dual = self.dual + _bends(self.ahead) / (12 * self._STEP)
            self.dual = dual / (dual.norm(dim=0) / self.beta).clamp_min(1)
            rest = gradient - self.slope + self._STEP * _bends_adjoint(self.dual)
            slope = gradient - rest * (1 - self._STEP / rest.norm(dim=0).clamp_min(1e-9)).clamp_min(0)
            self.ahead, self.slope = 2 * slope - self.slope, slope
        return self.slope


def _bends(slope: Tensor) -> Tensor:
    """The symmetric derivative of (3, …) as six parts whose squares add up to those of all nine."""
    return torch.stack(
        [
            _difference(slope[a], a) if a == b else (_difference(slope[a], b) + _difference(slope[b], a)) / math.sqrt(2)
            for a, b in _PAIRS
        ]
    )


def _bends_adjoint(bends: Tensor) -> Tensor:
    found = torch.zeros_like(bends[:3])
    for (a, b), bend in zip(_PAIRS, bends, strict=True):
        share = 0.5 if a == b else 1 / math.sqrt(2)
        found[a] += share * _adjoint(bend, b)
        found[b] += share * _adjoint(bend, a)
    return found


class Staged(Regulariser):
    """Total variation for the first `first` steps; then a cost that looks at the volume as it is, anew every `every` steps."""

    def __init__(self, *, first: int = 60, every: int = 30) -> None:
        self.first, self.every, self.num_calls, self.variation = first, every, 0, TotalVariation()

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        past, self.num_calls = self.num_calls - self.first, self.num_calls + 1
        if past < 0:
            return self.variation(volume, scale)
        if past % self.every == 0:
            with torch.no_grad():
                self.look(volume.detach(), scale)
        return self.cost(volume, scale)

    def look(self, volume: Tensor, scale: float) -> None:
        """What the volume tells."""

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        """The cost after that."""
        raise NotImplementedError


class Reweighted(Staged):
    """Jumps where the volume has an edge already count less (doi:10.1007/s00041-008-9045-x)."""

    def look(self, volume: Tensor, scale: float) -> None:
        self.share = (1 + _blurred(_squares(volume / scale)) / 0.3**2) ** -0.5

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        return (self.share * _size(_squares(volume), _SMOOTHING * scale)).sum()


class Directional(Staged):
    """Jumps along the normal of an edge that the volume has already count less; the same across the edge's face do not."""

    def __init__(self, share: float = 0.9, certain: float = 0.1, first: int = 30, every: int = 10) -> None:
        super().__init__(first=first, every=every)
        self.share, self.certain = share, certain

    def look(self, volume: Tensor, scale: float) -> None:
        gradient = _gradient(_blurred(volume))
        self.normal = gradient / ((gradient**2).sum(0) + (self.certain * scale) ** 2).sqrt()

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        gradient = _gradient(volume)
        along = (gradient * self.normal).sum(0)
        return _size((gradient**2).sum(0) - self.share * along**2, _SMOOTHING * scale).sum()


class Concave(Staged):
    """The logarithm of the jump, begun from a volume of total variation, so that large jumps are not shrunk."""

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        return scale * (0.5 * torch.log1p(_size(_squares(volume / scale), _SMOOTHING) / 0.5)).sum()


class GreyLevels(Staged):
    """Total variation, and a pull of voxels to the grey level beside them, levels being the peaks of the histogram where a
    volume of total variation is flat. What is far from all levels is left alone: few of the scenes have few levels."""

    _SHARE, _REACH = 0.5, 0.15

    def __init__(self) -> None:
        super().__init__(every=1000)

    def look(self, volume: Tensor, scale: float) -> None:
        values = volume / scale
        flat = values[(_squares(values) < 0.1**2) & (values > 0.05)]
        count, edges = np.histogram(flat.numpy(), 200, (0, 2))
        count = gaussian_filter1d(count.astype(float), 3)
        peaks, _ = find_peaks(count, prominence=0.05 * count.max())
        self.levels = torch.tensor([0.0, *((edges[peaks] + edges[peaks + 1]) / 2)], dtype=volume.dtype)

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        values = volume / scale
        nearest = self.levels[torch.bucketize(values.detach(), (self.levels[1:] + self.levels[:-1]) / 2)]
        squared = (values - nearest) ** 2
        pull = self._REACH * (squared / (squared + self._REACH**2)).sum()
        return self.variation(volume, scale) + self._SHARE * scale * pull


class PluggedIn(Staged):
    """Half-quadratic splitting (doi:10.1109/TIP.2011.2112669): half of total variation, and the squared distance to the volume
    as a denoiser returns it, which is called every 30 steps."""

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser

    def look(self, volume: Tensor, scale: float) -> None:
        self.cleaned = self.denoiser(volume / scale)

    def cost(self, volume: Tensor, scale: float) -> Tensor:
        distance = scale * ((volume / scale - self.cleaned) ** 2).sum()
        return 0.5 * self.variation(volume, scale) + distance


Candidate = Callable[[Scene], Regulariser]  # made for each fit: some remember what they saw


def _always(make: Callable[[], Regulariser]) -> Candidate:
    return lambda scene: make()


CANDIDATES: dict[str, Candidate] = {
    "total-variation": _always(TotalVariation),
    "second-order": _always(SecondOrderVariation),
    "second-order, c = 0.3": _always(partial(SecondOrderVariation, curvature=0.3)),
    "group sparsity, 2³": _always(GroupSparsity),
    "TV, z counts 0.7": _always(partial(FlatterAlongBeam, 0.7)),
    "TV, z counts 1.4": _always(partial(FlatterAlongBeam, 1.4)),
    "TV + 0.1 attenuation": _always(partial(WithAttenuation, 0.1)),
    "directional": _always(DirectionalVariation),
    "directional, discount 0.9": _always(partial(DirectionalVariation, 0.9)),
    "directional, in stages": _always(Directional),
    "reweighted TV": _always(Reweighted),
    "logarithm, from TV": _always(Concave),
    "Hessian–Schatten": _always(partial(Schatten, 1.0)),
    "TV + Hessian–Schatten": _always(partial(Schatten, 0.5)),
    "TGV": _always(partial(GeneralisedVariation, 1.0)),
    "grey levels": _always(GreyLevels),
    "non-local means": _always(partial(PluggedIn, non_local_means)),
    "network, phantoms": lambda scene: PluggedIn(phantom_network()),
    "network, tilts": lambda scene: PluggedIn(tilt_network(scene)),
}
