"""Choice of the field by the likelihood of held-out pixels, on the slab."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from noiseflow.progress import Progress
from recon.fields.fields import Field
from recon.fields.files import field_kinds
from recon.joint.joint import JointReconstructor
from recon.joint.plan import FitStage
from recon.names import AUTO
from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries, VolumeGrid

_HELD_OUT = 0.1  # share of the pixels of the slab


@dataclass(frozen=True)
class FieldChoice:
    """A field and the evidence for it.

    Attributes:
        name: the chosen field.
        tried: field → held-out negative log-likelihood of the slab, nats per pixel, in the order tried.
        slices: number of slices of the slab.
    """

    name: str
    tried: dict[str, float]
    slices: int

    def in_words(self) -> str:
        """The choice in one line."""
        others = ", ".join(
            f"{name} {nll - self.tried[self.name]:+.4f}" for name, nll in self.tried.items() if name != self.name
        )
        return f"{self.name} ({others} nats per held-out pixel of {self.slices} slices)"


def choose_field(
    fit: JointReconstructor,
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    kinds: Mapping[str, type[Field]],
    *,
    progress: Progress | None = None,
) -> FieldChoice:
    """Reconstruct the slab with each field, and choose the one that predicts held-out pixels best.

    Noise model and weight are chosen with the first field, grids, and kept for the others, so that only the field differs.

    Args:
        fit: the joint fit of the series.
        tilt_series, grid: data and grid of the whole volume.
        kinds: the fields by name.
        progress: called with a task, completed and expected steps, and a note.
    """
    rows = contrast_slab(tilt_series, fit.num_slices(grid))
    slab, slab_grid = tilt_series.rows(rows), replace(grid, height=rows.stop - rows.start)
    tried: dict[str, float] = {}
    fit, chosen = replace(fit, held_out=_HELD_OUT), fit.weight is None
    for name, kind in kinds.items():
        prefix = f"{fit.prefix}field {name}: "
        weight = fit.weight * kind.relative_weight if chosen and fit.weight is not None else fit.weight
        result = replace(fit, make_field=kind, prefix=prefix, weight=weight)(slab, slab_grid, progress=progress)
        if not tried:
            fixed = result.likelihood or result.noise_model
            if fixed is not None:
                fit = replace(fit, weight=result.weight, noise_model=partial(fixed.requires_grad_, False))
        tried[name] = math.inf if result.fit_result is None else result.fit_result.held_out_nll
    return FieldChoice(min(tried, key=lambda name: tried[name]), tried, slab_grid.height)


def trial_stages(fit: JointReconstructor, field: str | None) -> list[FitStage]:
    """The stages of the choice, for the plan; none if the field is given."""
    if field != AUTO:
        return []
    steps = fit.schedule.whole if fit.num_steps is None else fit.num_steps
    return [
        FitStage(
            "choose field", "fields", "slab", "chosen", steps, rate=fit.schedule.rate, fits=len(field_kinds(field))
        )
    ]
