"""Tomography as a signal model: the noise-free pixel values of a volume."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.models.base import Described
from recon.fields.fields import Field
from recon.fields.occupancy import Occupancy
from recon.fields.regularisers.base import Regulariser
from recon.fields.regularisers.second_order import TotalVariation
from recon.projection.base import Projector, from_columns, from_rays
from recon.projection.image_formation import Linear, Transmission
from recon.projection.tiles import Tiles

_RESPONSE_RATE = 0.04  # learning rate of the detector response relative to that of the volume


class TomographySignal(Described):
    """A volume, its projections and the detector response as one signal model for `noiseflow.fit`.

    Pixels are numbered in the projector's native order (tilt, u, y), flat: ``images.transpose(0, 2, 1).reshape(-1)``.

    Args:
        projector: computes line integrals along all rays.
        image_formation: converts line integrals to signals, such as `Transmission` or `Linear`.
        weight: weight of the regulariser, nats per unit jump of attenuation (in units of the field's scale) over one voxel
            face.
        regulariser: regulariser of the volume; isotropic total variation by default.
        learning_rate: learning rate of a voxel field.
        occupancy: voxels where the field is evaluated, with vacuum elsewhere; None for all. Requires a projector with tiles.

    Attributes:
        keep_slopes: whether `penalty` uses every slope of the regulariser twice, until `release`.
        slope: slope of the regulariser that the next call of `penalty` uses, if there is one.
        turn: number of slopes taken, whose bits say along which axes the next one flips the volume.

    Raises:
        ValueError: an occupancy is given, but the projector does not support tiles.

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
            raise ValueError("this projector cannot skip vacuum; do not give an occupancy with it")
        self.field, self.projector, self.image_formation = field, projector, image_formation
        self.weight, self.learning_rate = weight, learning_rate
        self.regulariser = TotalVariation() if regulariser is None else regulariser
        self.occupancy = occupancy
        self._values: Tensor | None = None
        self._tiles: Tiles | None = None
        self._tiles_of: tuple[Tensor | None, int] = None, 0
        self._seen: tuple[tuple[object, ...], Tensor] | None = None
        self.turn, self._steps_follow, self.keep_slopes = 0, False, False
        self.slope: Tensor | None = None
        self.register_load_state_dict_post_hook(lambda model, _: model.go_on_from({}))  # type: ignore[no-untyped-call]

    def extra_repr(self) -> str:
        return f"{self.projector!r}, weight={self.weight:.4g}, {self.regulariser!r}"

    @property
    def num_pixels(self) -> int:
        """Number of pixels of the tilt series."""
        return self.projector.num_tilts * self.projector.detector_width * self.field.height

    def signal(self) -> Tensor:
        """The signal of all pixels, flat; reuses the result of a preceding `forward`, with its gradient."""
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
        """The field on the whole voxel grid, (depth * width, height), or on the list of `tiles`."""
        seen: Tensor = self.field() if self.occupancy is None else self.field.on(self.tiles) * self.field.scale
        return seen

    def rays(self, values: Tensor) -> Tensor:
        """Line integrals of values on the whole voxel grid or on the list of `tiles`, in the projector's native order."""
        return self.projector.project(values) if self.occupancy is None else self.tiles.project(values)

    def _project(self, values: Tensor) -> Tensor:
        """Line integrals; unoccupied blocks are tested in the backward pass."""
        occupancy, projector, rays = self.occupancy, self.projector, self.rays(values)
        if occupancy is not None and rays.requires_grad:
            cost = self.weight / (float(self.field.scale) * self.num_pixels)
            rays.register_hook(lambda gradient: occupancy.retest(gradient, projector, cost))  # type: ignore[no-untyped-call]
        return rays

    @property
    def tiles(self) -> Tiles:
        """The currently occupied tiles. Raises ValueError if there is no occupancy."""
        if self.occupancy is None:
            raise ValueError("this signal model has no occupancy; all voxels are evaluated, use volume() instead")
        mask = self.occupancy.mask
        known, version = self._tiles_of
        if self._tiles is None or known is not mask or version != mask._version:
            if self._tiles is None or not torch.equal(self._tiles.mask, mask):
                self._tiles = Tiles(mask, self.projector, known=self._tiles)
            self._tiles_of = mask, mask._version
        return self._tiles

    def volume(self) -> Tensor:
        """The attenuation, (z, y, x), detached."""
        with torch.no_grad():
            return self.volume_of(self._evaluate())

    def volume_of(self, values: Tensor) -> Tensor:
        """The volume (z, y, x) of values on the whole voxel grid or on the list of `tiles`."""
        columns = values if self.occupancy is None else self.tiles.lattice(values)
        return from_columns(columns, self.field.depth).contiguous()

    @torch.no_grad()
    def images(self) -> NDArray[np.float32]:
        """The signal of all pixels as images (tilt, y, u)."""
        rays = self.signal().view(-1, self.field.height)
        return np.ascontiguousarray(from_rays(rays, self.projector.num_tilts).cpu().numpy())

    def forward(self, pixels: Tensor) -> Tensor:
        """The signal of some pixels. Without gradients, all pixels are projected once per state of the parameters. The graph is
        kept between steps, because the next step starts from the same state."""
        if torch.is_grad_enabled():
            return self.signal()[pixels]
        # fused optimisers do not change the version of tensors, but every step calls signal()
        if self._seen is None or self._seen[0] != self._changes:
            with torch.set_grad_enabled(self._steps_follow):
                signal = self.signal()  # may set the response
            self._seen = self._changes, signal
        return self._seen[1].detach()[pixels]

    def release(self) -> None:
        """Release the cache for the next step, if none follows soon."""
        self._values, self._steps_follow, self.keep_slopes = None, False, False
        self.go_on_from({})
        if self._seen is not None:
            self._seen = self._seen[0], self._seen[1].detach()

    def let_go(self) -> None:
        """Release everything that can be recomputed, such as matrices of tiles; the model remains usable."""
        self._values = self._seen = self._tiles = None
        self._tiles_of, self._steps_follow = (None, 0), False
        for parameter in self.parameters():
            parameter.grad = None

    @property
    def _changes(self) -> tuple[object, ...]:
        return tuple((each._version, each.requires_grad) for each in (*self.parameters(), *self.buffers()))

    def penalty(self) -> Tensor:
        """The weighted regulariser per pixel; reuses the volume evaluated by `signal`.

        With `keep_slopes`, every second call takes the slope of the one before: two steps of a fit differ little, and the
        regulariser takes up to half of their time. Its value is the slope times the volume, because it is homogeneous.
        Slopes flip the volume in turn along each axis, because regularisers take differences to one neighbour along each, so
        that a corner costs more or less by where it points: a box and a ball had 35.8 to 37.5 dB, by how they were mirrored.
        """
        values = self._evaluate() if self._values is None else self._values
        self._values = None
        scale = float(self.field.scale)
        factor = self.weight / (scale * self.num_pixels)
        if not (self.keep_slopes and values.requires_grad):
            return self.cost(values, scale) * factor
        known, self.slope = self.slope, None
        if known is None or known.shape != values.shape:  # occupied tiles have been added
            at = values.detach().requires_grad_()
            (known,) = torch.autograd.grad(self.cost(at, scale, self.turn), at)
            self.slope, self.turn = known, self.turn + 1
        return torch.dot(known.to(values).flatten(), values.flatten()) * factor

    def between_steps(self) -> dict[str, Tensor | None]:
        """What the next step takes from the last one besides the parameters."""
        return {"slope": self.slope, "turn": torch.tensor(self.turn)}

    def go_on_from(self, kept: dict[str, Tensor | None]) -> None:
        """Take back what `between_steps` returned; begin anew if there is nothing."""
        self.slope, self.turn = kept.get("slope"), int(kept.get("turn") or 0)

    def cost(self, values: Tensor, scale: float, turn: int = 0) -> Tensor:
        """The regulariser of values on the whole voxel grid or on the list of `tiles`, unweighted; bits of `turn` flip axes.

        Vacuum follows above and below the grid, as for the projector: without these faces, a haze that fills the grid costs
        nothing, and hides in a lower offset or a weaker beam.
        """
        shape = (self.field.depth, self.field.width, self.field.height)
        volume = values.view(shape) if self.occupancy is None else self.tiles.spread(values)
        flipped = [axis for axis in range(volume.dim()) if turn >> axis & 1]
        return self.regulariser(functional.pad(volume, (0, 0, 0, 0, 2, 2)).flip(flipped), scale)

    def like(self, field: Field, projector: Projector, **changed: Any) -> TomographySignal:
        """A model of another field with this response, which both share, and settings that are not `changed`."""
        kept = {name: getattr(self, name) for name in ("weight", "regulariser", "learning_rate")}
        return TomographySignal(field, projector, self.image_formation, **(kept | changed))

    def response(self) -> dict[str, list[float]]:
        """Current intensity and offset of every tilt; empty for other image formations."""
        formation = self.image_formation
        return formation.per_tilt(self.projector.num_tilts) if isinstance(formation, Transmission | Linear) else {}

    def hold_above(self, least_signal: float) -> None:
        """Set the lower bound of the signals without an object, detector units, where linear images have an offset to fit."""
        if isinstance(self.image_formation, Linear) and self.image_formation.vacuum.requires_grad:
            self.image_formation.least_offset.fill_(least_signal)

    def parameter_groups(self, *, rate: float = 1.0, hold_response: bool = False) -> list[dict[str, Any]]:
        """Parameters with their learning rates, for Adam.

        Args:
            rate: factor on all learning rates.
            hold_response: do not fit the detector response.
        """
        response = [p for p in self.image_formation.parameters() if p.requires_grad and not hold_response]
        usual, alike = self.learning_rate * rate, dict[float, list[nn.Parameter]]()
        for name, parameter in self.field.named_parameters():
            alike.setdefault(self.field.relative_rate * self.field.own_rates.get(name, 1.0), []).append(parameter)
        own = {"eps": 1e-15} | ({} if (kept := self.field.memory) is None else {"betas": (kept, kept)})
        groups: list[dict[str, Any]] = [{"params": some, "lr": usual * factor} | own for factor, some in alike.items()]
        return groups + ([{"params": response, "lr": usual * _RESPONSE_RATE}] if response else [])
