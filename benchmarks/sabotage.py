"""Independent tilt series, unspoilt and spoilt: each must be reconstructed correctly, or graded below good for the true reason.

Scenes and ways of spoiling are split at random into halves: limits are set on the used half, and the kept half judges them.
Evidence of every check is stored, so that limits can be fitted without another run.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.defects import WAYS, Source, Spoilt
from benchmarks.later_defects import AIMED_AT, EARLIER
from benchmarks.latest_defects import BEFORE
from benchmarks.other_series import other_series
from benchmarks.scenes import Cell, Results, Scene
from noiseflow.checks import Effect, Verdict, grade, ranked
from recon.methods._registry import reconstruct
from recon.metrics.metrics import compare
from recon.series.screening import require_specimen, screen
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.simulation import ACQUISITIONS, draw_noise, stored_type
from recon.verdict.judge import judge
from recon.verdict.table import CHECKS
from tests.independent_scenes import NOISES, RANGES, SCENES, IndependentSeries, independent_series

DATA = Path(__file__).parent.parent.parent / "shared" / "data"
"""Real series and series of other groups, beside the checkout."""
RIGHT = 0.3  # dB below the series without defects
SEED = 38
"""Seed of the halves and of the unspoilt series; the spoilt ones use the next."""
FRESH, WIDTHS = 912, (32, 40, 48, 56)
"""Seed and widths of as many unspoilt series again, which were drawn after the limits were set."""
# a truncated object and a nonlinear detector are faults, and so are fewer tilts than fine detail needs
PHANTOMS = [name for name in SCENES if name != "truncated_object"]
QUIET = ["Poisson 10", "Poisson 100", "Poisson 40, read noise", "scan noise"]
LOUD = [*QUIET, "detector blur", "outliers", "Poisson 2"]
TILTS = list(RANGES)[:2] + list(RANGES)[3:]
UNSPOILT, SMALL = 80, 32
STEPS = {"sirt": 20}
SAMPLED = {"joint": 20, "l2": 20}
"""Of slower methods, one in so many ways and unspoilt series is computed."""
_OTHER = 9  # added to the seed to get another object of the same type


def kept(names: Iterable[str]) -> set[str]:
    """The half of the names that judges."""
    mixed = sorted(names)
    Random(SEED).shuffle(mixed)
    return set(mixed[::2])


def judging() -> set[str]:
    """The ways that judge: half of the first ones, half of the later ones that no check was written for, half of the last."""
    return kept(EARLIER) | kept(BEFORE - EARLIER - AIMED_AT) | kept(set(WAYS) - BEFORE)


def run(results: Results, line: Callable[[str], None], *, size: int, method: str, seed: int, quick: bool) -> None:
    """Compute the result of every unspoilt series and of every way of spoiling; existing results are kept."""
    every = SAMPLED.get(method, 1)
    whole = every == 1 and not quick
    for number, (scene, noise, tilts) in enumerate(_unspoilt(SEED)[: 6 if quick else UNSPOILT // every]):
        width = size if number % 3 == 2 else SMALL
        key = f"good/{scene}, {noise}, {tilts}, {width}"
        _cell(results, line, key, partial(_good, scene, noise, tilts, width, method, seed + number))
    for number, (scene, noise, tilts) in enumerate(_unspoilt(FRESH)[: UNSPOILT if whole else 0]):
        width, own = WIDTHS[number % len(WIDTHS)], 1000 * FRESH + number
        key = f"fresh/{scene}, {noise}, {tilts}, {width}"
        _cell(results, line, key, partial(_good, scene, noise, tilts, width, method, own))
    for name, make in other_series(DATA if DATA.is_dir() else None).items() if whole else ():
        _cell(results, line, f"other/{name}", partial(_graded, make, method))
    random = Random(SEED + 1)
    judges = judging()
    drawn = [(way, random.choice(PHANTOMS), random.choice(QUIET), random.choice(TILTS)) for way in WAYS]
    some = drawn[:6] if quick else drawn[every - 1 :: every]
    for way, scene, noise, tilts in sorted(some, key=lambda each: each[0] not in judges):  # those that judge come first
        cell = scene, noise, tilts, size, method, seed + 100
        name = ", ".join((scene, noise, tilts, str(size)))
        _cell(results, line, f"reference/{name}", partial(_good, *cell))
        _cell(results, line, f"spoilt/{way}/{name}", partial(_spoilt, way, *cell))


def _unspoilt(seed: int) -> list[tuple[str, str, str]]:
    """Scene, noise and tilts in a random order."""
    cells = [(scene, noise, tilts) for scene in PHANTOMS for noise in LOUD for tilts in TILTS]
    Random(seed).shuffle(cells)
    return cells


def _cell(results: Results, line: Callable[[str], None], key: str, compute: Callable[[], Cell]) -> None:
    found = results.cell(key, compute)
    line(f"{key}: {found['grade']}; {', '.join(found['subjects'])}")


def _graded(make: Callable[[], TiltSeries], method: str) -> Cell:
    return _result(make(), method, None)[1]


def _good(scene: str, noise: str, tilts: str, size: int, method: str, seed: int) -> Cell:
    made = independent_series(scene, noise, tilts, size=size, seed=seed)
    volume, cell = _result(made.series, method, None)
    cell |= {"psnr": _psnr(volume, made.truth)}
    if cell["names"] == ["convergence"]:
        cell["psnr of twice the steps"] = _psnr(_result(made.series, method, None, longer=2)[0], made.truth)
    return cell


def false_alarm(cell: Cell) -> bool:
    """Whether an unspoilt series is graded below good, other than for too few steps if twice as many make the volume better."""
    better = (cell.get("psnr of twice the steps") or -np.inf) > (cell.get("psnr") or np.inf) + RIGHT
    return bool(cell["grade"] != "good") and not (cell["names"] == ["convergence"] and better)


def _spoilt(way: str, scene: str, noise: str, tilts: str, size: int, method: str, seed: int) -> Cell:
    made, other = (independent_series(scene, noise, tilts, size=size, seed=each) for each in (seed, seed + _OTHER))
    if np.allclose(made.truth, other.truth):  # the scene has no random details
        following = PHANTOMS[(PHANTOMS.index(scene) + 1) % len(PHANTOMS)]
        other = independent_series(following, noise, tilts, size=size, seed=seed + _OTHER)
    spoilt = spoil_independent(made, noise, way, other=other, seed=seed)
    try:
        volume, cell = _result(spoilt.series, method, spoilt.thickness)
    except ValueError as error:  # an error message is as good as a verdict
        return {"grade": "refused", "subjects": [], "reasons": [str(error)], "psnr": None}
    return cell | {"psnr": _psnr(volume, made.truth if spoilt.truth is None else spoilt.truth)}


def spoil_independent(made: IndependentSeries, noise: str, way: str, *, other: IndependentSeries, seed: int) -> Spoilt:
    """An independent series with one of the defects in `WAYS`, before or after its noise."""
    peak, late = float(made.clean.max()), WAYS[way].late
    images = made.series if late else replace(made.series, images=made.clean.astype(np.float32))
    truths = (each.truth.astype(np.float32) for each in (made, other))
    found = WAYS[way].spoil(Source(next(truths), images, next(truths), peak, np.random.default_rng(seed + 5)))
    spoilt = found if isinstance(found, Spoilt) else Spoilt(found)
    if late:
        return spoilt
    clean = np.maximum(spoilt.series.images.astype(float) / peak, 0)
    return replace(
        spoilt, series=replace(spoilt.series, images=NOISES[noise](clean, np.random.default_rng(seed + 2))[0])
    )


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


def _result(
    series: TiltSeries, method: str, thickness: int | None, *, longer: int = 1
) -> tuple[np.ndarray[Any, Any], Cell]:
    """Screen, reconstruct and grade a series, as the command does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        require_specimen(series)
        screening = screen(series)
        prepared = screening.passed(series)
        grid, steps = VolumeGrid.of(prepared, thickness), STEPS.get(method)
        result = reconstruct(prepared, grid, method=method, num_steps=steps and longer * steps, seed=0)
        return result.volume.attenuation, graded(judge(prepared, result, screening=screening))


def graded(verdict: Verdict) -> Cell:
    """Grade and reasons, and value, error, tolerance and share of every check."""
    parts = ("value", "error", "tolerance", "share")
    evidence = {name: [each[part] for part in parts] for name, each in verdict.evidence.items()}
    return {"grade": verdict.grade, "subjects": list(verdict.subjects), "evidence": evidence} | {
        "names": [finding.name for finding in verdict.findings]
    }


def graded_anew(cell: Cell) -> Cell:
    """The cell as the present table of checks grades its evidence; tolerances that depend on the series are those stored."""
    if "evidence" not in cell:
        return cell
    findings = []
    for name, check in CHECKS.items():
        if name in cell["evidence"]:
            value, error, stored, share = cell["evidence"][name]
            effect = Effect(value or 0.0, np.inf if error is None else error, share=share)
            findings.append(check.of(effect, stored if callable(check.tolerance) else check.tolerance))
    first = ranked(findings)
    names, subjects = [finding.name for finding in first], [finding.reason for finding in first]
    return cell | {"grade": grade(first), "names": names, "subjects": subjects}


def _psnr(volume: Any, truth: Any) -> float | None:
    """PSNR of the volume after matching gain and offset, because defects may change the units; None if shapes differ."""
    return compare(volume, truth.astype(np.float32), scaling="affine").psnr if volume.shape == truth.shape else None


def outcome(way: str, cell: Cell, reference: float) -> tuple[str, float | None]:
    """``right reason``, ``other reason``, ``harmless`` or ``missed``, and the loss in dB; None without a comparable volume."""
    loss = None if cell["psnr"] is None else reference - cell["psnr"]
    if cell["grade"] == "refused" or set(cell["subjects"][:1]) & set(WAYS[way].reasons):
        return "right reason", loss
    if cell["grade"] != "good":
        return "other reason", loss
    return "harmless" if loss is not None and loss < RIGHT else "missed", loss


def table(cells: dict[str, Cell]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows: every way and its series, which half it belongs to, its loss, and its outcome."""
    rows, judges = list[tuple[str, ...]](), judging()
    for key, cell in cells.items():
        kind, *names = key.split("/", 2)
        if kind != "spoilt":
            continue
        way, name = names
        found, loss = outcome(way, cell, cells[f"reference/{name}"]["psnr"])
        half = "kept" if way in judges else "used"
        cost = "" if loss is None else f"{loss:.1f}"
        rows.append(
            (way, name, half, cost, f"{found} ({cell['grade']}: {', '.join(cell['subjects'][:2]) or 'no reason'})")
        )
    return ("spoilt by", "series", "half", "loss (dB)", "outcome"), rows
