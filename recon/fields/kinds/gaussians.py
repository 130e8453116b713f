"""The volume as a sum of anisotropic Gaussians."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.distributions.numerics.elementwise import LONG
from recon.fields.fields import EMPTY, Field

# primitives per voxel: with ten parameters each, a third of the parameters of a grid
_PER_VOXEL = 0.036
# standard deviations along the principal axes, voxels: narrower Gaussians are unseen between voxels, wider ones slow
_NARROWEST, _WIDEST = 0.35, 3.0
_REACH = 3.0  # standard deviations; beyond, a Gaussian has 1 % of its peak
# steps after which Gaussians of less than this part of the mean mass move to where the loss is steepest
_MOVES, _WEAK = range(15, 91, 15), 0.2


class GaussianField(Field):
    """The sum of anisotropic Gaussians: they follow the object, and memory is proportional to their number.

    Each Gaussian is evaluated within three standard deviations. The exponent at the voxels of its window is a polynomial of
    second degree, so that windows of equal size are one small matrix product, forward and backward. In the first 90
    steps, weak Gaussians move to where the loss is steepest.

    Args:
        shape: (depth, height, width) of the voxel grid, voxels along (z, y, x).
        scale: see `Field`.
        count: number of Gaussians; by default 0.036 per voxel, a third of the parameters of a grid.

    Example:
        >>> import recon, torch
        >>> field = recon.GaussianField((8, 8, 8), count=5)
        >>> field.volume().shape, sum(p.numel() for p in field.parameters())
        (torch.Size([8, 8, 8]), 55)
    """

    steepness: Tensor
    num_steps_done: Tensor
    relative_rate, step_cost, relative_weight = 0.3, 4.0, 0.7
    # at one rate of 0.15 for all, sparse particles lose 1.2 dB and filaments 0.5; widths and rotations gain nothing by more
    own_rates: ClassVar[Mapping[str, float]] = {"peak": 2.0, "log_width": 0.5, "rotation": 0.5}

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0, count: int | None = None) -> None:
        super().__init__(shape, scale=scale)
        count = max(1, round(_PER_VOXEL * math.prod(shape))) if count is None else count
        self.centre = nn.Parameter(torch.zeros(count, 3))
        self.log_width = nn.Parameter(torch.zeros(count, 3))
        self.rotation = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.peak = nn.Parameter(torch.full((count,), -3.0))
        self.register_buffer("steepness", torch.zeros(count))
        self.register_buffer("num_steps_done", torch.zeros((), dtype=torch.long))
        self.start_from(torch.full((1, 1, 1), EMPTY * scale))

    def config(self) -> dict[str, Any]:
        return {"count": len(self.peak)}

    @torch.no_grad()
    def start_from(self, volume: Tensor) -> None:
        """Distribute Gaussians of one voxel in proportion to the attenuation."""
        size = (self.depth, self.height, self.width)
        shown = functional.interpolate(volume[None, None] / self.scale, size=size, mode="trilinear")[0, 0].clamp_min(0)
        share = shown.flatten().double()
        total = share.clamp_min(1e-3 * float(share.max().clamp_min(1e-12))).cumsum(0)
        count = len(self.peak)
        place = (torch.arange(count, device=total.device) + 0.5) * (total[-1] / count)
        index = torch.searchsorted(total, place).clamp_max(len(total) - 1)
        jitter = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).to(index.device) - 0.5
        z, rest = index // (self.height * self.width), index % (self.height * self.width)
        self.centre.copy_(torch.stack([z, rest // self.width, rest % self.width], -1) + jitter)
        self.log_width.zero_()
        self.rotation.copy_(self.rotation.new_tensor([1.0, 0, 0, 0]).expand_as(self.rotation))
        # the sum of all is the volume
        peak = float(total[-1]) / count / (2 * math.pi) ** 1.5
        self.peak.fill_(math.log(math.expm1(max(peak, EMPTY))))

    def standard_deviations(self) -> Tensor:
        """Standard deviations along the principal axes (n, 3)."""
        return self.log_width.clamp(math.log(_NARROWEST), math.log(_WIDEST)).exp()

    def units_at(self, points: Tensor) -> Tensor:
        size = (self.depth, self.height, self.width)
        exponents, nearest, radius = self._exponents(self.centre)
        margin = int(radius.max())
        padded = exponents.detach().new_zeros([each + 2 * margin for each in size])
        cell = torch.minimum(points.detach().round().clamp_min(0), points.new_tensor(size) - 1).long() + margin
        # the points of each voxel, one after the other
        cell, order = (cell * cell.new_tensor(padded.stride())).sum(-1).sort()
        count = torch.bincount(cell, minlength=padded.numel())
        first = count.cumsum(0) - count
        found = exponents.new_zeros(len(points))
        for chosen, _, places in _windows(nearest, radius, padded, margin, crowd=max(1, int(count.max()))):
            here = count[places].view(-1)
            which = torch.repeat_interleave(first[places].view(-1) - (here.cumsum(0) - here), here)
            point = order[which + torch.arange(len(which), device=which.device)]
            own = torch.repeat_interleave(chosen, count[places].sum(1))
            terms = _monomials(points[point] - nearest[own]).T
            found = found.index_add(0, point, (exponents[own] * terms).sum(-1).exp())
        return found

    def units(self) -> Tensor:
        centre: Tensor = self.centre
        if torch.is_grad_enabled() and centre.requires_grad:
            if int(self.num_steps_done) in _MOVES and bool(self.steepness.any()):
                self._move()
            centre = centre.clone()
            centre.register_hook(self._count)  # type: ignore[no-untyped-call]
        found: Tensor = _Splatting.apply(*self._exponents(centre), (self.depth, self.height, self.width))  # type: ignore[no-untyped-call]
        return found.transpose(1, 2)

    @torch.no_grad()
    def _count(self, gradient: Tensor) -> None:
        """Count a step, and add up how steep the loss is along each centre."""
        self.num_steps_done += 1
        self.steepness += gradient.norm(dim=1)

    @torch.no_grad()
    def _move(self) -> None:
        """Move every weak Gaussian to a steep one, and split that one along its longest axis: mass and extent are kept."""
        width, half = self.standard_deviations(), 0.5**0.5
        mass = functional.softplus(self.peak) * width.prod(1)
        weak = (mass < _WEAK * mass.mean()).nonzero()[:, 0]
        steep = self.steepness.index_fill(0, weak, -1).argsort(descending=True)[: len(mass) - len(weak)][: len(weak)]
        weak = weak[: len(steep)]
        longest = width[steep].argmax(1, keepdim=True)
        axis = rotations(self.rotation[steep])[torch.arange(len(steep), device=steep.device), :, longest[:, 0]]
        self.peak[steep] = torch.log(torch.expm1(half * functional.softplus(self.peak[steep])))
        self.log_width[steep] = width[steep].log().scatter_add(1, longest, torch.full_like(axis[:, :1], math.log(half)))
        shift = half * width[steep].gather(1, longest) * axis
        for parameter in self.parameters():
            parameter[weak] = parameter[steep]
        self.centre[weak] -= shift
        self.centre[steep] += shift
        self.steepness.zero_()

    def _exponents(self, centre: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients of `_polynomials` (n, 10), nearest voxels (n, 3), and radii of the windows (n,)."""
        width, axes = self.standard_deviations(), rotations(self.rotation)
        scaled = axes / width[:, None]
        reach = ((axes * width[:, None]).detach() ** 2).sum(-1).sqrt()
        nearest = centre.detach().round()
        last = nearest.new_tensor([self.depth, self.height, self.width]) - 1
        nearest = torch.minimum(nearest.clamp_min(0), last)
        exponents = _polynomials(scaled @ scaled.mT, nearest - centre, functional.softplus(self.peak).log())
        return exponents, nearest.long(), (_REACH * reach.amax(1)).round().long()


def rotations(quaternions: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4); the principal axes are the columns."""
    w, x, y, z = functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).view(-1, 3, 3)


def _polynomials(precision: Tensor, shift: Tensor, log_peak: Tensor) -> Tensor:
    """Coefficients (n, 10) of log peak − ½ (o + shift)ᵀ P (o + shift) for the monomials of `_monomials`."""
    linear = (precision @ shift[..., None]).squeeze(-1)
    constant = log_peak - 0.5 * (linear * shift).sum(-1)
    square = -0.5 * torch.diagonal(precision, dim1=1, dim2=2)
    mixed = -torch.stack([precision[:, 0, 1], precision[:, 0, 2], precision[:, 1, 2]], -1)
    return torch.cat([constant[:, None], -linear, square, mixed], -1)


def _monomials(offsets: Tensor) -> Tensor:
    """(10, N) 1, z, y, x, z², y², x², zy, zx, yx of offsets (N, 3)."""
    z, y, x = offsets.unbind(-1)
    return torch.stack([torch.ones_like(z), z, y, x, z * z, y * y, x * x, z * y, z * x, y * x])


class _Splatting(torch.autograd.Function):
    """The sum of Gaussians on a voxel grid (z, y, x), in windows around their nearest voxels."""

    @staticmethod
    def forward(ctx: Any, exponents: Tensor, nearest: Tensor, radius: Tensor, shape: tuple[int, int, int]) -> Tensor:
        margin = int(radius.max())
        padded = exponents.new_zeros([size + 2 * margin for size in shape])
        for chosen, monomials, places in _windows(nearest, radius, padded, margin):
            padded.view(-1).index_add_(0, places.view(-1), torch.exp_(exponents[chosen] @ monomials).view(-1))
        ctx.save_for_backward(exponents, nearest, radius)
        ctx.margin = margin
        inner = slice(margin, -margin)
        return padded[inner, inner, inner].contiguous()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        exponents, nearest, radius = ctx.saved_tensors
        margin, found = ctx.margin, torch.empty_like(exponents)
        padded = functional.pad(gradient, [margin] * 6)
        for chosen, monomials, places in _windows(nearest, radius, padded, margin):
            values = torch.exp_(exponents[chosen] @ monomials)
            values.mul_(padded.view(-1)[places])
            found[chosen] = values @ monomials.T
        return found, None, None, None


def _windows(
    nearest: Tensor, radius: Tensor, padded: Tensor, margin: int, *, crowd: int = 1
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Some Gaussians with windows of equal size: their indices (n,), the monomials (10, K) of the offsets, and the flat places
    (n, K) in the padded grid, whose first voxel is at −margin. Fewer at a time if there are up to `crowd` points in a voxel."""
    strides = nearest.new_tensor(padded.stride())
    base = ((nearest + margin) * strides).sum(-1)
    for size in torch.unique(radius).tolist():
        span = torch.arange(-size, size + 1, device=nearest.device)
        offsets = torch.stack(torch.meshgrid(span, span, span, indexing="ij"), -1).view(-1, 3)
        monomials = _monomials(offsets.to(padded.dtype))
        across = (offsets * strides).sum(-1)
        together = max(1, LONG // (crowd * len(offsets)))
        for chosen in torch.split((radius == size).nonzero()[:, 0], together):
            yield chosen, monomials, base[chosen, None] + across


FIELD = GaussianField
