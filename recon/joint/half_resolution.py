"""The first steps of a fit at half the resolution: an eighth of the voxels, shown to a quarter of the pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from recon.fields.occupancy import Occupancy
from recon.joint.signal_model import TomographySignal

_LEAST = 128  # voxels; half the resolution of 96 costs 0.2 dB of a volume of shells for a tenth of the time


class HalfResolution:
    """A signal model on a voxel grid half as fine, and the pixels it is fitted to: every second one along u and y.

    Each pixel keeps its own likelihood, which that of binned pixels would not follow: of clipped pixel values, the mean is
        another.
    Where the first of them stands differs from tilt to tilt, so that the volume is not shifted. Total variation weighs as much
    as at full resolution, for faces and pixels become fewer alike. Half of an odd number of voxels is a little too wide, half a
    pixel at the edges: good enough for a start.

    Args:
        signal_model: at full resolution; its image formation and its field's parameters are shared.

    Attributes:
        signal_model: the one at half the resolution.
    """

    @staticmethod
    def possible(signal_model: TomographySignal) -> bool:
        """Whether the field has a voxel grid half as fine, the projector has one, and there are voxels enough to save."""
        full = signal_model.projector
        wide = min(full.width, full.detector_width) >= _LEAST
        return wide and full.has_parts and signal_model.field.has_coarser

    def __init__(self, signal_model: TomographySignal) -> None:
        full, field = signal_model.projector, signal_model.field.coarser()
        if field is None:
            raise ValueError("this signal model has no half resolution; ask HalfResolution.possible first")
        tilts = np.arange(full.num_tilts)
        # of an odd number, the last pixel along u is left out at some tilts; rows are as many as coarse slices
        self._num_columns, self._first_columns = full.detector_width // 2, tilts % 2
        self._num_rows, self._first_rows = field.height, tilts // 2 % 2 * (signal_model.field.height % 2 == 0)
        projector = full.half(field.depth, field.width, self._num_columns, self._first_columns)
        if projector is None:
            raise ValueError(f"{type(full).__name__} has no half resolution; ask HalfResolution.possible first")
        self._full, occupancy = signal_model, signal_model.occupancy
        self.signal_model = TomographySignal(
            field,
            projector,
            signal_model.image_formation,
            weight=signal_model.weight,
            regulariser=signal_model.regulariser.at_half_resolution(),
            learning_rate=signal_model.learning_rate,
            occupancy=None if occupancy is None else occupancy.coarser((field.depth, field.height, field.width)),
        )

    def pixels(self, images: Tensor) -> Tensor:
        """Those that are fitted, of images (tilt, u, y)."""
        firsts = zip(images, self._first_columns, self._first_rows, strict=True)
        picked = [image[column::2, row::2][: self._num_columns, : self._num_rows] for image, column, row in firsts]
        return torch.stack(picked)

    def hand_over(self) -> None:
        """Let the signal model at full resolution begin from here: only around what was found anything is occupied."""
        coarse, full = self.signal_model, self._full
        if full.occupancy is not None:
            shape = full.field.depth, full.field.height, full.field.width
            found = Occupancy(
                coarse.volume() / coarse.field.scale, shape, least=full.occupancy.least, block=full.occupancy.block
            )
            full.occupancy.mask = found.to(full.occupancy.mask.device).mask
