"""The tomography as a signal model: what the detector would read of a volume, without noise."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.modules import Described
from recon.coordinate_network import CoordinateNetwork
from recon.fields import Field
from recon.occupancy import Occupancy
from recon.projector import SliceProjector, from_columns
from recon.regularisers import total_variation


class TomographySignal(Described):
    """A volume, its projections and the detector's response as one signal model, for `noiseflow.fit`.

    Pixels are numbered in the projector's native order: ``images.transpose(0, 2, 1)``, that is (tilt, u, y), made flat.

    Args:
        field: the volume.
        projector: line integrals along all rays.
        image_formation: line integrals to signals, such as `Transmission` or `Linear`.
        weight: of the total variation, nats per unit of jump in attenuation (in units of the field's scale) over one
            voxel face.
        smoothing: jumps below this, in units of the field's scale, count quadratically.
        learning_rate: of a field of voxels; the detector's response learns at a twentieth of it.
        occupancy: where the field is evaluated, the rest being vacuum; everywhere if None. For fields with a method ``at``.
    """

    def __init__(
        self,
        field: Field,
        projector: SliceProjector,
        image_formation: nn.Module,
        *,
        weight: float = 1.0,
        smoothing: float = 0.02,
        learning_rate: float = 0.2,
        occupancy: Occupancy | None = None,
    ) -> None:
        super().__init__()
        self.field, self.projector, self.image_formation = field, projector, image_formation
        self.weight, self.smoothing, self.learning_rate = weight, smoothing, learning_rate
        self.occupancy = occupancy
        self._columns: Tensor | None = None
        self._seen: tuple[tuple[int, ...], Tensor] | None = None

    def extra_repr(self) -> str:
        return f"{self.projector!r}, weight={self.weight:.4g}, smoothing={self.smoothing:.4g}"

    @property
    def num_pixels(self) -> int:
        """How many pixels the tilt series has."""
        return self.projector.num_tilts * self.projector.detector_width * self.field.height

    def signal(self) -> Tensor:
        """The signal of all pixels, flat."""
        self._columns, self._seen = self._evaluate(), None
        rays = self.projector.project(self._columns)
        shape = (self.projector.num_tilts, self.projector.detector_width, self.field.height)
        signal: Tensor = self.image_formation(rays.view(shape))
        return signal.reshape(-1)

    def _evaluate(self) -> Tensor:
        """The field where it is occupied, and vacuum elsewhere; what the data wants there is tested as gradients pass."""
        occupancy, field = self.occupancy, self.field
        if occupancy is None or not isinstance(field, CoordinateNetwork):
            everywhere: Tensor = field()
            return everywhere
        places = occupancy.indices()
        empty = torch.zeros(occupancy.mask.numel(), dtype=field.scale.dtype, device=field.scale.device)
        columns = empty.index_put((places,), field.at(places) * field.scale).view(-1, field.height)
        if columns.requires_grad:
            cost = self.weight / (float(field.scale) * self.num_pixels)
            columns.register_hook(lambda gradient: occupancy.retest(gradient, cost))  # type: ignore[no-untyped-call]
        return columns

    def volume(self) -> Tensor:
        """The attenuation that the signal is made of, (z, y, x), detached."""
        with torch.no_grad():
            return from_columns(self._evaluate(), self.field.depth).contiguous()

    def forward(self, pixels: Tensor) -> Tensor:
        """The signal of some pixels; without gradients, all are projected once for each state of the parameters."""
        if torch.is_grad_enabled():
            return self.signal()[pixels]
        # a fused optimiser does not count as a new version of its tensors, but no step comes without signal()
        version = tuple(parameter._version for parameter in self.parameters())
        if self._seen is None or self._seen[0] != version:
            signal = self.signal()
            self._seen = version, signal
        return self._seen[1][pixels]

    def penalty(self) -> Tensor:
        """The weighted total variation per pixel; after `signal` it reuses the volume evaluated there."""
        columns = self._evaluate() if self._columns is None else self._columns
        self._columns = None
        scale = float(self.field.scale)
        lattice = columns.view(self.field.depth, self.field.width, self.field.height)
        variation = total_variation(lattice, smoothing=self.smoothing * scale)
        return variation * (self.weight / (scale * self.num_pixels))

    def with_field(self, field: Field) -> TomographySignal:
        """The same detector and response, copied, in front of another field of as many voxels along z and x."""
        response = copy.deepcopy(self.image_formation)
        options = {"weight": self.weight, "smoothing": self.smoothing, "learning_rate": self.learning_rate}
        return TomographySignal(field, self.projector, response, occupancy=None, **options)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Parameters with their learning rates, for Adam."""
        response = [parameter for parameter in self.image_formation.parameters() if parameter.requires_grad]
        groups: list[dict[str, Any]] = [
            {
                "params": list(self.field.parameters()),
                "lr": self.learning_rate * self.field.relative_rate,
                "eps": 1e-15,
            }
        ]
        return groups + ([{"params": response, "lr": self.learning_rate / 20}] if response else [])
