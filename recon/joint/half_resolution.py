"""The first steps of a fit at half or quarter resolution. Each halving leaves 1/8 of the voxels and 1/4 of the pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from recon.fields.occupancy import Occupancy
from recon.joint.signal_model import TomographySignal


class HalfResolution:
    """A signal model on a voxel grid with half the resolution, fitted to every second pixel along u and y.

    Pixels are selected, not binned, so that the likelihood of single pixels applies; clipping would bias the means of bins. The
    first selected pixel alternates between tilts, so that the volume is not shifted. Total variation has the same weight as at
    full resolution, because the numbers of faces and pixels decrease by the same factor. For an odd number of voxels the coarse
    grid is slightly too wide, by half a pixel at the edges, which is good enough for the first steps.

    Args:
        signal_model: the signal model at full resolution; image formation and field parameters are shared.

    Attributes:
        signal_model: the signal model at half the resolution.
    """

    @staticmethod
    def times(signal_model: TomographySignal) -> int:
        """How often the resolution can be halved, 0 to 2. Field and projector must support it, and the volume must be large
        enough to benefit."""
        full, field, times = signal_model.projector, signal_model.field, 0
        width = min(full.width, full.detector_width) if full.has_parts else 0
        least = field.halved_from
        while times < len(least) and width >= least[times] and (coarser := field.coarser()) is not None:
            field, times = coarser, times + 1
        return times

    def __init__(self, signal_model: TomographySignal) -> None:
        full, field = signal_model.projector, signal_model.field.coarser()
        if field is None:
            raise ValueError("this signal model has no half resolution; check HalfResolution.times first")
        tilts = np.arange(full.num_tilts)
        # if the width is odd, the last pixel along u is dropped at some tilts; there are as many rows as coarse slices
        self._num_columns, self._first_columns = full.detector_width // 2, tilts % 2
        self._num_rows, self._first_rows = field.height, tilts // 2 % 2 * (signal_model.field.height % 2 == 0)
        projector = full.half(field.depth, field.width, self._num_columns, self._first_columns)
        if projector is None:
            raise ValueError(f"{type(full).__name__} has no half resolution; check HalfResolution.times first")
        self._full, occupancy = signal_model, signal_model.occupancy
        shape = field.depth, field.height, field.width
        changed = {"occupancy": None if occupancy is None else occupancy.coarser(shape)}
        coarser = signal_model.regulariser.at_half_resolution()
        self.signal_model = signal_model.like(field, projector, regulariser=coarser, **changed)

    def pixels(self, images: Tensor) -> Tensor:
        """The selected pixels of images (tilt, u, y)."""
        firsts = zip(images, self._first_columns, self._first_rows, strict=True)
        picked = [image[column::2, row::2][: self._num_columns, : self._num_rows] for image, column, row in firsts]
        return torch.stack(picked)

    def hand_over(self) -> None:
        """Continue at full resolution: the occupancy is restricted to the surroundings of the current volume."""
        coarse, full = self.signal_model, self._full
        if full.occupancy is not None:
            shape = full.field.depth, full.field.height, full.field.width
            found = Occupancy(
                coarse.volume() / coarse.field.scale, shape, least=full.occupancy.least, block=full.occupancy.block
            )
            full.occupancy.mask = found.to(full.occupancy.mask.device).mask
