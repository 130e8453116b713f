"""Choice of the field by the likelihood of held-out tilts, on the slab."""

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
from recon.series.holdout import Holdout
from recon.series.tilt_series import TiltSeries, VolumeGrid


def choose_field(
    fit: JointReconstructor,
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    kinds: Mapping[str, type[Field]],
    *,
    progress: Progress | None = None,
) -> tuple[str, str]:
    """Reconstruct the slab with each field, and choose one that predicts left-out tilts best; return it with the evidence.

    Fields differ most in directions that no tilt shows, so the tilts beside the missing wedge are left out; see
    `Holdout.as_missing`. Held-out pixels of all tilts distinguish fields less. Noise model and
    weight are chosen with the first field, grids, and kept for the others, so that only the field differs. Of fields within one
    standard error of the best, the last is chosen, which has the fewest parameters.

    Args:
        tilt_series, grid: data and grid of the whole volume.
        kinds: the fields by name.
    """
    rows = contrast_slab(tilt_series, fit.num_slices(grid))
    slab, slab_grid = tilt_series.rows(rows), replace(grid, height=rows.stop - rows.start)
    tried: dict[str, Tensor] = {}
    # on a slab of 48³ whose volumes have 18.5 (grids), 18.9 (network) and 19.3 dB (Gaussians), the first two are 7 and 2.5
    # standard errors behind by the outermost tilts; by pixels of all tilts, Gaussians are 0.6 behind the network
    left_out, searched = Holdout.as_missing(tilt_series.tilt_angles, HELD_OUT_TO_CHOOSE), fit.weight is None
    for name, kind in kinds.items():
        prefix = f"{fit.prefix}field {name}: "
        weight = fit.weight * kind.relative_weight if searched and fit.weight is not None else fit.weight
        one = replace(fit, make_field=kind, prefix=prefix, weight=weight)
        result, scores, blocks = one.judged(slab, slab_grid, held_out=left_out, progress=progress)
        if not tried:
            fixed = result.likelihood or result.noise_model
            if fixed is not None:
                fit = replace(fit, weight=result.weight, noise_model=partial(fixed.requires_grad_, False))
        tried[name] = scores
    best = max(tried, key=lambda name: float(tried[name].mean()))
    behind = {name: mean_and_error(tried[best] - scores, blocks) for name, scores in tried.items()}
    *_, chosen = (name for name, (excess, error) in behind.items() if name == best or excess <= error < math.inf)
    pairs = {name: mean_and_error(tried[chosen] - scores, blocks) for name, scores in tried.items() if name != chosen}
    others = ", ".join(f"{name} {excess:+.4f} ± {error:.4f}" for name, (excess, error) in pairs.items())
    return chosen, f"{chosen} ({others} nats per pixel of left-out tilts, {slab_grid.height} slices)"


def trial_stages(fit: JointReconstructor, field: str | None) -> list[FitStage]:
    """The stages of the choice, for the plan; none if the field is given."""
    if field != AUTO:
        return []
    steps, count = fit.schedule.whole if fit.num_steps is None else fit.num_steps, len(field_kinds(field))
    return [FitStage("choose field", "fields", "slab", "chosen", steps, rate=fit.schedule.rate, fits=count)]
