"""Choice of the field by the likelihood of held-out pixels, on the slab."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from noiseflow.progress import Progress
from recon.fields.fields import Field
from recon.fields.files import field_kinds
from recon.joint.joint import HELD_OUT_TO_CHOOSE, JointReconstructor
from recon.joint.plan import FitStage
from recon.names import AUTO
from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries, VolumeGrid


def choose_field(
    fit: JointReconstructor,
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    kinds: Mapping[str, type[Field]],
    *,
    progress: Progress | None = None,
) -> tuple[str, str]:
    """Reconstruct the slab with each field, and choose the one that predicts held-out pixels best; return it with the evidence.

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
    fit, searched = replace(fit, held_out=HELD_OUT_TO_CHOOSE), fit.weight is None
    for name, kind in kinds.items():
        prefix = f"{fit.prefix}field {name}: "
        weight = fit.weight * kind.relative_weight if searched and fit.weight is not None else fit.weight
        result = replace(fit, make_field=kind, prefix=prefix, weight=weight)(slab, slab_grid, progress=progress)
        if not tried:
            fixed = result.likelihood or result.noise_model
            if fixed is not None:
                fit = replace(fit, weight=result.weight, noise_model=partial(fixed.requires_grad_, False))
        tried[name] = math.inf if result.fit_result is None else result.fit_result.held_out_nll
    chosen = min(tried, key=lambda name: tried[name])
    others = ", ".join(f"{name} {nll - tried[chosen]:+.4f}" for name, nll in tried.items() if name != chosen)
    return chosen, f"{chosen} ({others} nats per held-out pixel of {slab_grid.height} slices)"


def trial_stages(fit: JointReconstructor, field: str | None) -> list[FitStage]:
    """The stages of the choice, for the plan; none if the field is given."""
    if field != AUTO:
        return []
    steps, count = fit.schedule.whole if fit.num_steps is None else fit.num_steps, len(field_kinds(field))
    return [FitStage("choose field", "fields", "slab", "chosen", steps, rate=fit.schedule.rate, fits=count)]
