"""Choice of the field by the likelihood of held-out pixels, on the slab."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from torch import Tensor

from noiseflow.fitting.contest import mean_and_error
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
    """Reconstruct the slab with each field, and choose one that predicts held-out pixels best; return it with the evidence.

    Noise model and weight are chosen with the first field, grids, and kept for the others, so that only the field differs. Of
    fields that held-out pixels do not distinguish, the last is chosen: what no tilt shows, networks and Gaussians fill in better.

    Args:
        fit: the joint fit of the series.
        tilt_series, grid: data and grid of the whole volume.
        kinds: the fields by name.
        progress: called with a task, completed and expected steps, and a note.
    """
    rows = contrast_slab(tilt_series, fit.num_slices(grid))
    slab, slab_grid = tilt_series.rows(rows), replace(grid, height=rows.stop - rows.start)
    tried: dict[str, Tensor] = {}
    fit, searched = replace(fit, held_out=HELD_OUT_TO_CHOOSE), fit.weight is None
    for name, kind in kinds.items():
        prefix = f"{fit.prefix}field {name}: "
        weight = fit.weight * kind.relative_weight if searched and fit.weight is not None else fit.weight
        one = replace(fit, make_field=kind, prefix=prefix, weight=weight)
        result, scores, blocks = one.judged(slab, slab_grid, progress=progress)
        if not tried:
            fixed = result.likelihood or result.noise_model
            if fixed is not None:
                fit = replace(fit, weight=result.weight, noise_model=partial(fixed.requires_grad_, False))
        tried[name] = scores
    best = max(tried, key=lambda name: float(tried[name].mean()))
    behind = {name: mean_and_error(tried[best] - scores, blocks) for name, scores in tried.items()}
    # on a slab of 48³, Gaussians are 0.2 and a network 2.1 standard errors behind grids, and 0.9 and 0.4 dB ahead in the volume
    *_, chosen = (name for name, (excess, error) in behind.items() if name == best or excess <= 2 * error < math.inf)
    own = behind[chosen][0]
    others = ", ".join(
        f"{name} {each - own:+.4f} ± {error:.4f}" for name, (each, error) in behind.items() if name != chosen
    )
    return chosen, f"{chosen} ({others} nats per held-out pixel of {slab_grid.height} slices)"


def trial_stages(fit: JointReconstructor, field: str | None) -> list[FitStage]:
    """The stages of the choice, for the plan; none if the field is given."""
    if field != AUTO:
        return []
    steps, count = fit.schedule.whole if fit.num_steps is None else fit.num_steps, len(field_kinds(field))
    return [FitStage("choose field", "fields", "slab", "chosen", steps, rate=fit.schedule.rate, fits=count)]
