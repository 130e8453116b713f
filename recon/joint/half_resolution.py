"""The first steps of a fit at half the resolution, or half of that: an eighth of the voxels, shown to a quarter of the pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from recon.fields.occupancy import Occupancy
from recon.joint.signal_model import TomographySignal

_LEAST = 128, 257
"""Voxels from which the resolution is halved once, and twice. Half the resolution of 96 costs 0.2 dB of a volume of shells for a
tenth of the time; a quarter of that of 256 gains 0.11 and 0.08 dB on shells and particles, loses 0.20 and 0.32 on filaments and a
slab, and takes 40 % more time."""


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
    def times(signal_model: TomographySignal) -> int:
        """How often the resolution can be halved, up to twice: whether the field has voxel grids so much finer than its coarsest,
        the projector has them too, and there are voxels enough to save."""
        full, field, times = signal_model.projector, signal_model.field, 0
        width = min(full.width, full.detector_width) if full.has_parts else 0
        while times < len(_LEAST) and width >= _LEAST[times] and field.has_coarser:
            coarser = field.coarser()
            if coarser is None:
                break
            field, times = coarser, times + 1
        return times

    def __init__(self, signal_model: TomographySignal) -> None:
        full, field = signal_model.projector, signal_model.field.coarser()
        if field is None:
            raise ValueError("this signal model has no half resolution; ask HalfResolution.times first")
        tilts = np.arange(full.num_tilts)
        # of an odd number, the last pixel along u is left out at some tilts; rows are as many as coarse slices
        self._num_columns, self._first_columns = full.detector_width // 2, tilts % 2
        self._num_rows, self._first_rows = field.height, tilts // 2 % 2 * (signal_model.field.height % 2 == 0)
        projector = full.half(field.depth, field.width, self._num_columns, self._first_columns)
        if projector is None:
            raise ValueError(f"{type(full).__name__} has no half resolution; ask HalfResolution.times first")
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
