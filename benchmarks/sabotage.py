"""Tilt series with deliberate defects: each must be reconstructed correctly, or graded doubtful or bad for the true reason."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import rarer_defects  # noqa: F401  (registers its ways, after those of spoiling)
from benchmarks.defects import WAYS, Source, Spoilt
from benchmarks.needle import load
from benchmarks.scenes import Cell, Results, Scene, make_scene
from noiseflow.checks import Verdict
from recon.methods._registry import reconstruct
from recon.metrics.metrics import compare
from recon.series.screening import require_specimen, screen
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.simulation import ACQUISITIONS, draw_noise, stored_type
from recon.verdict.judge import judge

SCENES = (("shells", "clipped"), ("particles", "low-dose"), ("filaments", "8-bit"))
STANDARD = tuple(
    (phantom, noise)
    for phantom in ("shells", "virions", "filaments", "particles", "slab")
    for noise in ("clipped", "skewed", "outliers", "low-dose", "8-bit")
)
TILTS = "-60:60:3"
RIGHT = 0.3  # dB below the series without defects
_OTHER = 9  # added to the seed to get another object of the same type
Result = tuple[TiltSeries, Any, Verdict]


def run(
    results: Results,
    line: Callable[[str], None],
    *,
    size: int,
    method: str,
    seed: int,
    quick: bool,
    in_turn: bool = False,
) -> None:
    """Compute the result of each good series and of each scene with each defect; existing results are kept.

    If `in_turn`, each defect is applied to one scene only, alternating between scenes, which takes a third of the time.
    """
    for phantom, noise in SCENES if quick else STANDARD:
        _cell(results, line, f"good/{phantom}, {noise}", partial(_good, phantom, noise, size, method, seed))
    _cell(results, line, "good/needle", lambda: _graded(_result(load(), method, seed)[2]))
    for number, (phantom, noise) in enumerate(SCENES[:1] if quick else SCENES):
        for name in list(WAYS)[number :: len(SCENES)] if in_turn else WAYS:
            key = f"{phantom}, {noise}/{name}"
            _cell(results, line, key, partial(_spoilt, phantom, noise, name, size, method, seed))


def _cell(results: Results, line: Callable[[str], None], key: str, compute: Callable[[], Cell]) -> None:
    found = results.cell(key, compute)
    line(f"{key}: {found['grade']}; {', '.join(found['subjects'])}")


def _scene(phantom: str, noise: str, size: int, seed: int) -> Scene:
    return make_scene(size, phantom=phantom, noise=noise, tilts=TILTS, seed=seed)


def _good(phantom: str, noise: str, size: int, method: str, seed: int) -> Cell:
    scene = _scene(phantom, noise, size, seed)
    _, result, verdict = _result(scene.noisy, method, seed)
    return _graded(verdict) | {"psnr": _psnr(result, scene.truth)}


def _spoilt(phantom: str, noise: str, name: str, size: int, method: str, seed: int) -> Cell:
    scene, other = _scene(phantom, noise, size, seed), _scene(phantom, noise, size, seed + _OTHER)
    spoilt = spoil(scene, name, other=other, seed=seed + 5)
    truth = scene.truth if spoilt.truth is None else spoilt.truth
    try:
        _, result, verdict = _result(spoilt.series, method, seed, spoilt.thickness)
    except ValueError as error:  # an error message is as good as a verdict
        return {"grade": "refused", "subjects": [], "reasons": [str(error)], "psnr": None}
    return _graded(verdict) | {"psnr": _psnr(result, truth)}


def spoil(scene: Scene, name: str, *, other: Scene, seed: int) -> Spoilt:
    """The noisy series of a scene with one of the defects in `WAYS`; `other` provides foreign objects."""
    way, generator = WAYS[name], np.random.default_rng(seed)
    intensity = next(each.intensity for each in ACQUISITIONS.values() if _made(each.noise) == repr(scene.noise_model))
    images = scene.noisy if way.late else scene.clean
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # warnings about deliberately wrong angles
        found = way.spoil(Source(scene.truth, images, other.truth, intensity, generator))
        spoilt = found if isinstance(found, Spoilt) else Spoilt(found)
        if way.late:
            return spoilt
        drawn = np.stack(list(draw_noise(spoilt.series.images, scene.noise_model, seed=seed)))
        noisy = drawn.astype(stored_type(scene.noise_model))
        return replace(spoilt, series=replace(spoilt.series, images=noisy))


def _made(make: Callable[[], Any] | None) -> str:
    return "" if make is None else repr(make())


def _result(series: TiltSeries, method: str, seed: int, thickness: int | None = None) -> Result:
    """Screen, reconstruct and grade a series, as the command does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        require_specimen(series)
        screening = screen(series)
        prepared = screening.passed(series)
        result = reconstruct(prepared, VolumeGrid.of(prepared, thickness), method=method, seed=seed)
        return prepared, result, judge(prepared, result, screening=screening)


def _graded(verdict: Verdict) -> Cell:
    """Grade and reasons, and the evidence of every check, from which limits can be fitted without another run."""
    found = {"grade": verdict.grade, "subjects": list(verdict.subjects), "reasons": list(verdict.reasons)}
    return found | {"evidence": verdict.evidence, "not_tested": verdict.not_tested}


def _psnr(result: Any, truth: Any) -> float | None:
    """PSNR of the volume after matching gain and offset, because defects may change the units; None if shapes differ."""
    volume = result.volume.attenuation
    return compare(volume, truth, scaling="affine").psnr if volume.shape == truth.shape else None


def outcome(name: str, cell: Cell, unspoilt: float) -> str:
    """Outcome of one defect: ``right``, ``named``, ``other reason`` or ``missed``."""
    right = cell["psnr"] is not None and cell["psnr"] >= unspoilt - RIGHT
    if cell["grade"] == "refused" or set(cell["subjects"][:2]) & set(WAYS[name].reasons):
        return "named"
    if right:
        return "right"
    return "missed" if cell["grade"] == "good" else "other reason"


def table(cells: dict[str, Cell]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows: every defect by scene, with counts in the last rows."""
    scenes = sorted({key.split("/")[0] for key in cells} - {"good"})
    rows: list[tuple[str, ...]] = []
    counts: dict[str, int] = {}
    for name in WAYS:
        words = []
        for scene in scenes:
            cell, good = cells.get(f"{scene}/{name}"), cells.get(f"good/{scene}")
            if cell is None or good is None:
                words.append("")
                continue
            kind = outcome(name, cell, good["psnr"])
            counts[kind] = counts.get(kind, 0) + 1
            words.append(f"{kind} ({cell['grade']}: {', '.join(cell['subjects'][:2]) or 'no reason'})")
        rows.append((name, *words))
    return ("spoilt by", *scenes), rows + _counted(cells, counts, len(scenes))


def _counted(cells: dict[str, Cell], counts: dict[str, int], width: int) -> list[tuple[str, ...]]:
    good = {key: cell for key, cell in cells.items() if key.startswith("good/")}
    alarms = [key.partition("/")[2] for key, cell in good.items() if cell["grade"] != "good"]
    kinds: Sequence[str] = ("right", "named", "other reason", "missed")
    summary = [(f"total {kind}", str(counts.get(kind, 0)), *[""] * (width - 1)) for kind in kinds]
    words = f"{len(alarms)} of {len(good)}" + (f": {'; '.join(alarms)}" if alarms else "")
    return [*summary, ("false alarms", words, *[""] * (width - 1))]
