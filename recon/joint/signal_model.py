"""The tomography as a signal model: what the detector would read of a volume, without noise."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.models.base import Described
from recon.fields.fields import Field
from recon.fields.occupancy import Occupancy
from recon.fields.regularisers.base import Regulariser
from recon.fields.regularisers.total_variation import TotalVariation
from recon.projection.base import Projector, from_columns
from recon.projection.image_formation import Linear, Transmission
from recon.projection.tiles import Tiles

_RESPONSE_RATE = 0.04  # learning rate of the detector's response, relative to the volume's


class TomographySignal(Described):
    """A volume, its projections and the detector's response as one signal model, for `noiseflow.fit`.

    Pixels are numbered in the projector's native order: ``images.transpose(0, 2, 1)``, that is (tilt, u, y), made flat.

    Args:
        field: the volume.
        projector: line integrals along all rays.
        image_formation: line integrals to signals, such as `Transmission` or `Linear`.
        weight: of the total variation, nats per unit of jump in attenuation (in units of the field's scale) over one
            voxel face.
        regulariser: what is expected of a volume; isotropic total variation by default.
        learning_rate: of a field of voxels.
        occupancy: where the field is evaluated, the rest being vacuum; everywhere if None. For a projector that has parts.

    Raises:
        ValueError: an occupancy for another projector.

    Example:
        >>> import recon, torch
        >>> projector = recon.SliceProjector(tilt_angles=[-30.0, 0.0, 30.0], depth=8, width=8)
        >>> model = recon.TomographySignal(recon.VoxelField((8, 4, 8)), projector, recon.Transmission(intensity=100.0))
        >>> model(torch.tensor([0, 1, 2])).shape, model.signal().shape
        (torch.Size([3]), torch.Size([96]))
    """

    def __init__(
        self,
        field: Field,
        projector: Projector,
        image_formation: nn.Module,
        *,
        weight: float = 1.0,
        regulariser: Regulariser | None = None,
        learning_rate: float = 0.2,
        occupancy: Occupancy | None = None,
    ) -> None:
        super().__init__()
        if occupancy is not None and not projector.has_parts:
            raise ValueError("vacuum is left out only where the projector has parts; give no occupancy with this one")
        self.field, self.projector, self.image_formation = field, projector, image_formation
        self.weight, self.learning_rate = weight, learning_rate
        self.regulariser = TotalVariation() if regulariser is None else regulariser
        self.occupancy = occupancy
        self._values: Tensor | None = None
        self._tiles: Tiles | None = None
        self._tiles_of: tuple[Tensor | None, int] = None, 0
        self._seen: tuple[tuple[object, ...], Tensor] | None = None
        self._steps_follow = False

    def extra_repr(self) -> str:
        return f"{self.projector!r}, weight={self.weight:.4g}, {self.regulariser!r}"

    @property
    def num_pixels(self) -> int:
        """How many pixels the tilt series has."""
        return self.projector.num_tilts * self.projector.detector_width * self.field.height

    def signal(self) -> Tensor:
        """The signal of all pixels, flat; what `forward` has just seen is taken over, with its gradient."""
        seen = self._seen
        if seen is not None and seen[1].requires_grad and torch.is_grad_enabled() and seen[0] == self._changes:
            self._seen = None
            return seen[1]
        self._values, self._seen, self._steps_follow = self._evaluate(), None, torch.is_grad_enabled()
        rays = self._project(self._values)
        shape = (self.projector.num_tilts, self.projector.detector_width, self.field.height)
        signal: Tensor = self.image_formation(rays.view(shape))
        return signal.reshape(-1)

    def _evaluate(self) -> Tensor:
        """The field on the whole voxel grid, (depth * width, height), or as the list of `tiles`."""
        if self.occupancy is None:
            everywhere: Tensor = self.field()
            return everywhere
        return self.field.on(self.tiles) * self.field.scale

    def _project(self, values: Tensor) -> Tensor:
        """Line integrals; what the data wants where the voxel grid counts as empty is tested as gradients pass."""
        occupancy, projector = self.occupancy, self.projector
        if occupancy is None:
            return projector.project(values)
        rays = self.tiles.project(values)
        if rays.requires_grad:
            cost = self.weight / (float(self.field.scale) * self.num_pixels)
            rays.register_hook(lambda gradient: occupancy.retest(gradient, projector, cost))  # type: ignore[no-untyped-call]
        return rays

    @property
    def tiles(self) -> Tiles:
        """What is occupied, as it is now.

        Raises:
            ValueError: there is no occupancy.
        """
        if self.occupancy is None:
            raise ValueError("every voxel is evaluated: this signal model was made without an occupancy")
        mask = self.occupancy.mask
        known, version = self._tiles_of
        if self._tiles is None or known is not mask or version != mask._version:
            if self._tiles is None or not torch.equal(self._tiles.mask, mask):
                self._tiles = Tiles(mask, self.projector, known=self._tiles)
            self._tiles_of = mask, mask._version
        return self._tiles

    def volume(self) -> Tensor:
        """The attenuation that the signal is made of, (z, y, x), detached."""
        with torch.no_grad():
            values = self._evaluate()
            columns = values if self.occupancy is None else self.tiles.lattice(values)
            return from_columns(columns, self.field.depth).contiguous()

    def forward(self, pixels: Tensor) -> Tensor:
        """The signal of some pixels; without gradients, all are projected once for each state of the parameters. Between steps
        their gradient is kept, for the next one begins where this look was."""
        if torch.is_grad_enabled():
            return self.signal()[pixels]
        # a fused optimiser does not count as a new version of its tensors, but no step comes without signal()
        if self._seen is None or self._seen[0] != self._changes:
            with torch.set_grad_enabled(self._steps_follow):
                signal = self.signal()  # which may set a response that is matched to it
            self._seen = self._changes, signal
        return self._seen[1].detach()[pixels]

    def release(self) -> None:
        """Let go of what was kept for a next step: none follows for now."""
        self._values, self._steps_follow = None, False
        if self._seen is not None:
            self._seen = self._seen[0], self._seen[1].detach()

    def let_go(self) -> None:
        """Let go of all that can be made again, matrices of tiles above all: no fit follows, but the model may be asked."""
        self._values = self._seen = self._tiles = None
        self._tiles_of, self._steps_follow = (None, 0), False
        for parameter in self.parameters():
            parameter.grad = None

    @property
    def _changes(self) -> tuple[object, ...]:
        tensors = [*self.parameters(), *self.buffers()]
        return tuple((tensor._version, tensor.requires_grad) for tensor in tensors)

    def penalty(self) -> Tensor:
        """The weighted regulariser per pixel; after `signal` it reuses the volume evaluated there."""
        values = self._evaluate() if self._values is None else self._values
        self._values = None
        scale = float(self.field.scale)
        if self.occupancy is None:
            cost = self.regulariser(values.view(self.field.depth, self.field.width, self.field.height), scale)
        else:
            cost = self.regulariser.of_tiles(values, self.tiles, scale)
        return cost * (self.weight / (scale * self.num_pixels))

    def with_field(self, field: Field) -> TomographySignal:
        """The same detector and response, copied, in front of another field of as many voxels along z and x."""
        response = copy.deepcopy(self.image_formation)
        return TomographySignal(
            field,
            self.projector,
            response,
            weight=self.weight,
            regulariser=self.regulariser,
            learning_rate=self.learning_rate,
        )

    def response(self) -> dict[str, list[float]]:
        """Intensity and offset of every tilt as they are; nothing for an image formation of another kind."""
        formation = self.image_formation
        return formation.per_tilt(self.projector.num_tilts) if isinstance(formation, Transmission | Linear) else {}

    def parameter_groups(self, *, rate: float = 1.0, hold_response: bool = False) -> list[dict[str, Any]]:
        """Parameters with their learning rates, for Adam.

        Args:
            rate: factor on all of them.
            hold_response: leave the detector's response as it is.
        """
        response = [p for p in self.image_formation.parameters() if p.requires_grad and not hold_response]
        usual = self.learning_rate * rate
        groups: list[dict[str, Any]] = [
            {"params": list(self.field.parameters()), "lr": usual * self.field.relative_rate, "eps": 1e-15}
        ]
        return groups + ([{"params": response, "lr": usual * _RESPONSE_RATE}] if response else [])
