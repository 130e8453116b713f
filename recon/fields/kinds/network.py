"""The volume as a network from coordinates to attenuation, evaluated once on the occupied voxels for the rays of all tilts:
one of sines, and that of Kniesel et al. (CVPR 2022)."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from noiseflow.distributions.numerics.elementwise import LONG
from recon.fields.fields import COARSE, EMPTY, Field

_CACHED = 2**12  # activations of so many points stay in the cache of a core
# steps with which a network first learns the rough volume, which starts the fit near the object
_FIRST_STEPS = 60


class SineNetwork(nn.Module):
    """Fully connected layers with sine activations (Sitzmann et al., NeurIPS 2020, arXiv:2006.09661).

    Args:
        width: units of each hidden layer.
        frequency: factor on the phases: the highest initial frequency, radians per half width of the volume.
    """

    def __init__(self, width: int, layers: int, frequency: float) -> None:
        super().__init__()
        self.frequency = frequency
        self.hidden = nn.ModuleList(nn.Linear(width if index else 3, width) for index in range(layers))
        self.last = nn.Linear(width, 1)
        for index, layer in enumerate(self.hidden):
            bound = math.sqrt(6 / width) / frequency if index else 1 / 3
            nn.init.uniform_(layer.weight, -bound, bound)  # type: ignore[arg-type]

    def forward(self, points: Tensor) -> Tensor:
        """Values (N,) at points (N, 3)."""
        values = points
        for layer in self.hidden:
            weight, bias = (self.frequency * parameter for parameter in layer.parameters())
            values = torch.sin(functional.linear(values, weight, bias))
        found: Tensor = self.last(values)
        return found.squeeze(-1)


class CoordinateNetwork(Field):
    """The volume as a sine network of the coordinates, with few parameters and no voxel grid of its own.

    Coordinates (x, y, z) are relative to the centre, in units of half the width. The network first learns the rough volume by
    least squares.

    Args:
        shape: (depth, height, width) of the voxel grid, voxels along (z, y, x).
        scale: see `Field`.
        width: units of each hidden layer.
        frequency: see `SineNetwork`.

    Example:
        >>> import recon, torch
        >>> field = recon.CoordinateNetwork((8, 8, 8), width=16)
        >>> field.volume().shape, bool((field.volume() >= 0).all())
        (torch.Size([8, 8, 8]), True)
        >>> field.at(torch.tensor([[0.5, 3.25, 7.4]])).shape  # between voxels
        torch.Size([1])
    """

    # 300 steps at twice the rate lose 0.2 dB in the mean of twelve scenes, and 0.3 dB in projections
    num_steps, relative_rate, relative_weight = 450, 0.004, 0.7
    memory = None  # that with which the rate was chosen
    step_cost = 4.0
    # half of the steps on fewer voxels: 48³ shells -0.05 dB, particles +0.8, at 2/3 of the time; three quarters: -0.6 to -1.6.
    # From 96 voxels on, more steps at a quarter before: 96³ shells +0.1 dB (projections +0.3), particles and slab +0.9 to 1.0
    halved_from = (32, 96)
    # three layers of 64 before and after the sine, and their gradients, in bytes
    more_memory = 4 * LONG * 4 * 3 * 64

    def __init__(
        self, shape: Sequence[int], *, scale: float = 1.0, width: int = 64, layers: int = 3, frequency: float = 30.0
    ) -> None:
        super().__init__(shape, scale=scale)
        self.layer_width, self.layers, self.frequency = width, layers, frequency
        self.network = self.make_network()

    def make_network(self) -> nn.Module:
        """The network from (N, 3) coordinates to (N,) values."""
        network = SineNetwork(self.layer_width, self.layers, self.frequency)
        nn.init.constant_(network.last.bias, math.log(math.expm1(EMPTY)))
        return network

    def config(self) -> dict[str, Any]:
        return {"width": self.layer_width, "layers": self.layers, "frequency": self.frequency}

    def positive(self, values: Tensor) -> Tensor:
        """Attenuation in units of the scale from values of the network."""
        return functional.softplus(values)

    def start_from(self, volume: Tensor) -> None:
        box = (self.depth, self.width, self.height)
        target = self._raw_of(volume, [min(COARSE, *pair) for pair in zip(box, volume.mT.shape, strict=True)])
        axes = [
            (torch.arange(size, device=target.device) + 0.5) * (own / size) - 0.5
            for own, size in zip(box, target.shape, strict=True)
        ]
        z, x, y = torch.meshgrid(*axes, indexing="ij")
        points = torch.stack([z, y, x], -1).view(-1, 3).to(self.scale)
        optimiser = torch.optim.Adam(self.parameters())
        nn.init.constant_(self.network.last.bias, float(target.mean()))  # type: ignore[union-attr, arg-type]
        with torch.enable_grad():
            for _ in range(_FIRST_STEPS):
                optimiser.zero_grad()
                (self._values(points) - target.reshape(-1)).square().mean().backward()  # type: ignore[no-untyped-call]
                optimiser.step()
        optimiser.zero_grad()

    def coarser(self) -> Field | None:
        """The same network on half as many voxels along each axis."""
        half = [(size + 1) // 2 for size in (self.depth, self.height, self.width)]
        field = type(self)(half, scale=2 * float(self.scale), **self.config()).to(self.scale.device)
        field.network = self.network
        return field

    def units(self) -> Tensor:
        everywhere = torch.arange(self.depth * self.width * self.height, device=self.scale.device)
        return self.of_voxels(everywhere).view(self.depth, self.width, self.height)

    def of_voxels(self, places: Tensor) -> Tensor:
        y, x = places % self.height, places // self.height % self.width
        return self.units_at(torch.stack([places // (self.height * self.width), y, x], -1).to(self.scale.dtype))

    def units_at(self, points: Tensor) -> Tensor:
        return self.positive(self._values(points))

    def _values(self, points: Tensor) -> Tensor:
        size = points.new_tensor([self.depth, self.height, self.width])
        coordinates = ((2 * points + 1 - size) / self.width).flip(-1)
        parts = torch.split(coordinates, _CACHED)
        # activations of one part are in memory; those of more parts are computed again in the backward pass
        if len(coordinates) <= LONG:
            return torch.cat([self.network(part) for part in parts])
        return torch.cat([checkpoint(self.network, part, use_reentrant=False) for part in parts])


DENSEST = 4.0
"""Attenuation of a density of one, in units of the field's scale."""


class CoordinateDensity(nn.Module):
    """Density in (0, 1) at points of the cube [-1, 1]³: fully connected layers on a positional encoding, with a final sigmoid.

    Args:
        frequencies: number of octaves of the encoding, with sine and cosine each.
        skip: number of hidden layers after which the encoding is concatenated again; 0 for none.
    """

    def __init__(self, frequencies: int, layers: int, width: int, skip: int) -> None:
        super().__init__()
        self.frequencies, self.skip = frequencies, skip
        encoded = 6 * frequencies
        sizes = [encoded, *[width] * (layers - 1)]
        if skip:
            sizes[skip] += encoded
        self.hidden = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.last = nn.Linear(width, 1)

    def forward(self, points: Tensor) -> Tensor:
        """Density (...) at points (..., 3)."""
        encoded = self.encode(points)
        values = encoded
        for index, layer in enumerate(self.hidden):
            if self.skip and index == self.skip:
                values = torch.cat([encoded, values], -1)
            values = functional.relu(layer(values))
        return torch.sigmoid(self.last(values)).squeeze(-1)

    def encode(self, points: Tensor) -> Tensor:
        """Sines and cosines of π·2ᵏ times each coordinate, (..., 6·frequencies)."""
        octaves = math.pi * 2.0 ** torch.arange(self.frequencies, dtype=points.dtype, device=points.device)
        phases = (points[..., None, :] * octaves[:, None]).flatten(-2)
        return torch.cat([torch.sin(phases), torch.cos(phases)], -1)


class PaperField(CoordinateNetwork):
    """The network of the paper (doi:10.1109/CVPR52688.2022.02018) as a field on a voxel grid.

    Args:
        shape, scale: see `recon.Field`; the attenuation of a density of one is four units of the scale.
        width, layers, frequencies, skip: see `CoordinateDensity`.
    """

    relative_rate = 0.005
    # 72 times the products of the sine network
    step_cost = 500.0
    # outputs of nine layers of 256, and of the encoding twice, in bytes
    more_memory = 4 * LONG * (9 * 256 + 2 * 60)

    def __init__(
        self,
        shape: Sequence[int],
        *,
        scale: float = 1.0,
        width: int = 256,
        layers: int = 9,
        frequencies: int = 10,
        skip: int = 5,
    ) -> None:
        self.octaves, self.skip = frequencies, skip
        super().__init__(shape, scale=scale, width=width, layers=layers)

    def make_network(self) -> nn.Module:
        return CoordinateDensity(self.octaves, self.layers, self.layer_width, self.skip)

    def config(self) -> dict[str, Any]:
        return {"width": self.layer_width, "layers": self.layers, "frequencies": self.octaves, "skip": self.skip}

    def positive(self, values: Tensor) -> Tensor:
        return values * DENSEST

    def start_from(self, volume: Tensor) -> None:
        """Initialise with a constant, the mean of the volume."""
        share = (volume.mean() / self.scale / DENSEST).clamp(1e-3, 0.5)
        with torch.no_grad():
            self.network.last.bias.copy_(torch.logit(share))  # type: ignore[union-attr, operator]


FIELD = CoordinateNetwork
FIELDS = {"kniesel2022": PaperField}
