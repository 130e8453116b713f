"""Search for the best settings of other methods by the score of a benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes import Scene
from noiseflow.fitting.signal_models import choose_weight
from recon.denoise import find_denoiser
from recon.joint.joint import JointReconstructor
from recon.methods.sirt import LineIntegralProblem
from recon.projection.classical import WINDOWS, sirt, wbp
from recon.series.tilt_series import TiltSeries, VolumeGrid

Array = NDArray[Any]
Candidate = tuple[str, Array]
CUTOFFS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
ITERATIONS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
FIRST_WEIGHT = 0.2
_APART = (-2, -1, 1, 2, 3)
"""The search first tries the first weight times these powers of `_FAR`, because a local search alone stops at the first local
maximum. For the needle with 10 counts and every fifth tilt held out, voxels had one at 0.4 (30.3 dB), far from the global one at
4.6 (35.5 dB). With the true noise, a much too low weight keeps an early state: 22.3 dB at 0.025, 21.5 at 0.2, 22.6 at 0.8."""
_FAR = 4.0
STEPS = 360
"""Steps of the fits of other methods: three times those of the joint fit, so that they converge."""


@dataclass(frozen=True)
class Best:
    """The best of some candidates.

    Attributes:
        setting: name of the best setting.
        volume: (z, y, x).
        tried: setting → score of all candidates.
    """

    setting: str
    volume: Array
    tried: dict[str, float]

    @property
    def at_an_end(self) -> bool:
        """Whether the best setting is the first or last one tried, so that a wider search might find a better one."""
        return len(self.tried) > 1 and self.setting in (next(iter(self.tried)), list(self.tried)[-1])


def empty_volume(scene: Scene) -> Best:
    """No attenuation anywhere: a score that every method has to exceed."""
    return Best("no attenuation", np.zeros_like(scene.truth), {})


def best(candidates: Iterable[Candidate], score: Callable[[Array], float]) -> Best:
    """The candidate with the highest score; the first one if scores are equal."""
    found: Best | None = None
    tried: dict[str, float] = {}
    for setting, volume in candidates:
        tried[setting] = score(volume)
        if found is None or tried[setting] > tried[found.setting]:
            found = Best(setting, volume, tried)
    if found is None:
        raise ValueError("there are no candidates; give at least one")
    return found


def back_projections(
    tilt_series: TiltSeries, grid: VolumeGrid, windows: Sequence[str] = tuple(WINDOWS)
) -> Iterator[Candidate]:
    """Back-projections for all windows and cutoffs."""
    problem = LineIntegralProblem.of(tilt_series, grid)
    for window in windows:
        for cutoff in CUTOFFS:
            volume = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff)
            yield f"{window}, cutoff {cutoff:g}", volume.numpy()


def sirts(tilt_series: TiltSeries, grid: VolumeGrid) -> Iterator[Candidate]:
    """SIRT by numbers of iterations."""
    problem, volume, done = LineIntegralProblem.of(tilt_series, grid), None, 0
    for count in ITERATIONS:
        volume = sirt(problem.line_integrals, problem.projector, num_iterations=count - done, start=volume)
        done = count
        yield f"{count} iterations", volume.numpy()


def best_fit(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    reconstructor: JointReconstructor,
    score: Callable[[Array], float],
    *,
    first: float = FIRST_WEIGHT,
) -> Best:
    """The fit at the total-variation weight with the highest score.

    The search takes the best of a few widely spaced weights, brackets it in factors of two, and interpolates.

    Args:
        tilt_series: the data.
        grid: the voxel grid.
        reconstructor: the fit whose weight is searched.
        score: function of a volume.
        first: initial weight.
    """
    found: dict[float, Array] = {}
    scores: dict[float, float] = {}

    def loss(weight: float) -> float:
        if weight not in scores:
            found[weight] = replace(reconstructor, weight=weight)(tilt_series, grid).volume.attenuation
            scores[weight] = score(found[weight])
        return -scores[weight]

    start = min((first * _FAR**power for power in (0, *_APART)), key=loss)
    loss(choose_weight(loss, start).weight)
    weight = max(scores, key=lambda each: scores[each])
    tried = {f"weight {each:.3g}": scores[each] for each in sorted(scores)}
    return Best(f"weight {weight:.3g}", found[weight], tried)


def denoised(tilt_series: TiltSeries, denoiser: str) -> TiltSeries:
    """The series with every image denoised separately."""
    denoise = find_denoiser(denoiser, tilt_series.images)
    return replace(tilt_series, images=np.stack([denoise(image) for image in tilt_series.images]))
