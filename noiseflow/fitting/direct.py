"""Fits to known signals by a quasi-Newton method on cells of alike pixels: seconds of Adam become tenths."""

import math
import time

import torch
from torch import Tensor

from noiseflow.distributions.numerics.elementwise import LONG
from noiseflow.fitting.cells import Cells, count, gather
from noiseflow.fitting.pixel_split import JUDGED_LAST, FitPixels, thinned
from noiseflow.fitting.steps import FitResult, lbfgs, snapshot
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.standardisation import Standardisation
from noiseflow.progress import Progress
from noiseflow.statistics import ENOUGH

# Iterations between two evaluations of the held-out pixels, and evaluations without a gain after which a fit stops. After four,
# a spline flow stopped by chance at 0.0039 nats per pixel above the truth, and went on to 0.0017. Flows rest on plateaus for 200.
_ROUND, _PATIENCE = 10, 8


def fit_directly(
    noise_model: NoiseModelBase,
    signal: Tensor,
    pixels: FitPixels,
    result: FitResult,
    *,
    num_steps: int,
    patience: int | None = None,
    weight: Tensor | None = None,
    standardise: bool = True,
    progress: Progress | None = None,
) -> FitResult:
    """Maximise the likelihood of single pixels by L-BFGS; keep the weights that are best on the held-out pixels.

    Args:
        noise_model: a model that `fits_directly`.
        signal: (N,) signals.
        pixels: training and held-out pixels.
        result: filled in and returned.
        num_steps, patience: largest numbers of iterations, and of evaluations without a gain (by default 8).
        weight: (N,) weights of the pixels; 1 by default.
        standardise: measure the scaling of the data first.
        progress: called with a task, completed and expected steps, and a note.

    Raises:
        ValueError: the likelihood is not finite.
    """
    started, counted = time.perf_counter(), pixels if weight is None else pixels.repeated(weight)
    if standardise:
        chosen = thinned(counted.train, ENOUGH)
        noise_model.scale_to(signal[chosen], pixels.observation[chosen])
    learner, needed = noise_model.learner(pixels.observation)
    parts = [part[needed[part]] for part in (pixels.train, pixels.judge)]
    scale = Standardisation().to(signal.device)
    scale.smooths = True
    scale.set_from(signal[parts[0]], pixels.observation[parts[0]], smooth=False)  # steps of width
    given = [each for each in (signal, pixels.observation, weight) if each is not None]
    train, judge = (_cells(learner, scale, *(each[part] for each in given)) for part in parts)
    learnt = [p for p in noise_model.parameters() if p.requires_grad]
    starts = [each.detach().clone() for each in learnt]
    optimiser = lbfgs(learnt, max_iter=_ROUND, history_size=5 * _ROUND)

    def loss() -> Tensor:
        optimiser.zero_grad()
        value, rough = _loss(learner, train), learner.roughness or 0.0
        if noise_model.pull:
            rough = rough + noise_model.pull / 2 * sum(
                (p - q).square().sum() for p, q in zip(learnt, starts, strict=True)
            )
        value = value + rough / pixels.train.numel()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    @torch.no_grad()
    def held_out() -> float:
        return float(_loss(learner, judge))

    best, kept, since = held_out(), snapshot(noise_model), 0
    result.history = {result.num_steps: best}  # after the edges of levels have moved, earlier values do not compare
    while result.num_steps < num_steps and since < (patience or _PATIENCE):
        optimiser.param_groups[0]["max_iter"] = min(_ROUND, num_steps - result.num_steps)
        before = [each.detach().clone() for each in learnt]
        optimiser.step(loss)  # type: ignore[no-untyped-call]
        if all(map(torch.equal, before, learnt)):  # at the maximum
            break
        result.num_steps += optimiser.param_groups[0]["max_iter"]
        found = held_out()
        if not math.isfinite(found):
            break
        result.history[result.num_steps] = found
        if progress is not None:
            progress("fit", result.num_steps, num_steps, f"held-out NLL {found:.4f}")
        since = 0 if found < best else since + 1
        if found < best:
            best, kept = found, snapshot(noise_model)
    noise_model.load_state_dict(kept)
    if not math.isfinite(best):
        raise ValueError("the likelihood of the pixels is NaN or infinite at every step; check the data's scale")
    chosen = thinned(counted.judge, JUDGED_LAST)
    with torch.no_grad():
        result.held_out_nll = -float(pixel_log_prob(noise_model, signal[chosen], pixels.observation[chosen]).mean())
    result.seconds = time.perf_counter() - started
    return result


def _cells(
    noise_model: NoiseModelBase, scale: Standardisation, signal: Tensor, observation: Tensor, *weight: Tensor
) -> Cells:
    counted = count(signal, observation, *weight) if noise_model.describes_single_readings else None
    if counted is not None:
        return counted._replace(values=_values(noise_model, counted.signal, counted.values))
    values = _values(noise_model, signal, observation)
    return gather(scale, signal, values, *weight, low=noise_model.low, high=noise_model.high)


@torch.no_grad()
def _values(noise_model: NoiseModelBase, signal: Tensor, observation: Tensor) -> Tensor:
    """The fixed part of the likelihood of each pixel if there is one, otherwise the observation."""
    parts = zip(torch.split(signal, LONG), torch.split(observation, LONG), strict=True)
    found = [noise_model.fixed_part(s, o) for s, o in parts]
    return observation if found[0] is None else torch.cat([each for each in found if each is not None])


def _loss(noise_model: NoiseModelBase, cells: Cells) -> Tensor:
    signal, values, _ = cells
    found = noise_model.log_prob_from(signal, values) if values.ndim > 1 else noise_model(signal).log_prob(values)
    return -torch.dot(found.to(cells.weight.dtype), cells.weight)
