"""Findings about shifts, angles, beam and fit from the residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.series.tilt_series import block_mean
from recon.verdict.distortions import Distortion
from recon.verdict.residuals import Residuals, neighbours
from recon.verdict.verdict import Finding

_SCATTER, _TREND, _OFFSET = (
    1.4,
    2.1,
    2.8,
)  # standard errors: for about forty tilts, random values are 1 ± 0.1, 1 ± 0.3 and 0 ± 1
_PIXELS, _SMOOTH_PIXELS = 0.25, 0.13  # rms; a volume absorbs a part of every shift, so the true shifts are larger
_MAGNIFIED = 0.15  # pixels at the image edge; standard scenes that are too noisy for a significant trend reach 0.11
_AT_ANGLES = 0.9  # pixels at the image edge from tilt to tilt; a smoothness prior leaves only a smooth trend
_GONIOMETER = (
    0.0175  # radians, one degree: more than the repeatability of a stage; for wide images a pixel corresponds to less
)
_TURN = 0.06  # pixels at the edge, common to all images; standard scenes reach 0.049
_TURN_OFFSET = 2.3  # standard errors of the same: probability of 1 in 50 by chance; standard scenes reach 1.03
_OFF_MIDDLE = 0.12  # pixels, common to all images, not absorbed by the volume; standard scenes reach 0.06
_USUAL_EDGE, _BLURRED = 24.0, 0.5  # pixels from centre to edge for these limits; limit that blurs images of any size
_BRIGHT = 0.18  # share of the contrast; total variation reduces weak contrast by up to 0.14 at some tilts
_BLOCK, _SMOOTH = (
    8,
    0.65,
)  # pixels; smooth share: shifted or rotated objects reach at most 0.6, because their residuals are at edges
_RESIDUAL = 0.06  # unexplained share of the structure, beyond the contrast lost by regularisation


def image_findings(residuals: Residuals, found: dict[str, Distortion]) -> tuple[dict[str, Any], list[Finding]]:
    """Evidence and findings of the residuals at full resolution."""
    (share, error), white = residuals.unexplained(), residuals.whiteness()
    edge = residuals.images.shape[2] / 2
    evidence = {
        "residual structure": share,
        "residual structure error": error,
        "whiteness": white,
        "noise over contrast": residuals.noise / max(residuals.contrast, 1e-30),
        "distortions": {name: _as_dict(one) for name, one in found.items()},
    }
    findings = [*_shifts(found, edge), *_geometry(found, edge), *_turned(found, edge), *_beam(found)]
    smooth, limit = _smooth_part(residuals), _RESIDUAL + _taken(residuals, found)
    evidence["smooth residuals"] = smooth
    if share - 3 * error > limit and smooth > _SMOOTH:
        words = f"{smooth:.0%} of the structure common to the residuals is smooth and differs between tilts: the background moves"
        findings.append(Finding("beam", 1.5, words, "subtract the background of each image first"))
    if share - 3 * error > limit:
        words = f"the residuals contain {share:.0%} of the images' structure; neighbours along y correlate by {white['y']:.2f}"
        findings.append(
            Finding(
                "residuals",
                min(3.5, (share - 3 * error) / limit),
                words,
                "look for the moving part in the residuals of the report",
                "general",
            )
        )
    return evidence, findings


def _taken(residuals: Residuals, found: dict[str, Distortion]) -> float:
    """Share of residual structure due to reduced contrast, caused by the regulariser and not by a defect of the series.

    It is accepted only if the noise is stronger than the contrast.
    """
    missing = max(0.0, found["brightness"].mean) if residuals.noise > residuals.contrast else 0.0
    return (missing / (1 + missing)) ** 2


def _smooth_part(residuals: Residuals) -> float:
    """Share of correlated residuals that is smooth (common to neighbouring blocks) and differs between tilts. Early stopping also
    leaves smooth residuals, but equal ones at all tilts."""
    height, width = residuals.residual.shape[1:]
    if min(height, width) < 2 * _BLOCK:
        return 0.0
    whole, chance = (
        neighbours(residuals.residual, 1),
        float(np.mean(residuals.residual**2)) / np.sqrt(residuals.residual.size),
    )
    blocks = np.stack([block_mean(each, _BLOCK, _BLOCK) for each in residuals.residual])
    own = neighbours(blocks, 1) - max(0.0, neighbours(blocks, 0))
    return float(own / max(whole, chance, 1e-30))


def _strength(one: Distortion, least: float, smooth: float) -> float:
    """Strength of a distortion, relative to limits of significance and of relevance."""
    whole = one.size / least if one.scatter > _SCATTER else 0.0
    curve = one.smooth / smooth if one.trend > _TREND else 0.0
    return max(whole, curve)


def _shifts(found: dict[str, Distortion], edge: float) -> list[Finding]:
    across, along, smooth = found["shift across"], found["shift along y"], _at_edge(_SMOOTH_PIXELS, edge)
    strengths = {
        "across the axis": _strength(across, _PIXELS, smooth),
        "along the axis": _strength(along, _PIXELS, smooth),
    }
    where = max(strengths, key=lambda name: strengths[name])
    chosen = across if "across" in where else along
    size = max(chosen.size, chosen.smooth)
    off = abs(across.mean) / _at_edge(_OFF_MIDDLE, edge) if abs(across.offset) > _OFFSET else 0.0
    if max(strengths[where], off) < 1:
        return []
    if off > strengths[where]:
        where, size = "across the axis", float(np.hypot(size, across.mean))
    words = f"the images are shifted {where} relative to the volume, by at least {size:.2f} pixels rms"
    return [
        Finding("alignment", max(strengths[where], off), words, "align the series first, or use --refine-alignment")
    ]


def _at_edge(pixels: float, edge: float) -> float:
    """A limit for rotations, magnifications and smooth shifts, pixels. It is proportional to the width of the image, because
    tilts sample its edge more coarsely, up to the limit of visible blur."""
    return max(pixels, min(_BLURRED, pixels * edge / _USUAL_EDGE))


def _geometry(found: dict[str, Distortion], edge: float) -> list[Finding]:
    magnified, angle = found["magnification"], found["tilt angle"]
    strengths = {
        "grow and shrink": _strength(magnified, 2 * _PIXELS, _at_edge(_MAGNIFIED, edge)),
        "seem taken at other angles": angle.rough / max(_AT_ANGLES, _GONIOMETER * edge)
        if angle.scatter > _SCATTER
        else 0.0,
    }
    what = max(strengths, key=lambda each: strengths[each])
    if strengths[what] < 1:
        return []
    words = (
        f"along the series the images {what} relative to the volume: tilt angles are wrong, the tilt axis is rotated, or the "
        "specimen or its magnification changes"
    )
    return [
        Finding("geometry", strengths[what], words, "check the angle file and --tilt-axis, or use --refine-alignment")
    ]


def _turned(found: dict[str, Distortion], edge: float) -> list[Finding]:
    turn = found["rotation"]
    strength = max(
        _strength(turn, 2 * _PIXELS, _at_edge(_SMOOTH_PIXELS, edge)),
        abs(turn.mean) / _at_edge(_TURN, edge) if abs(turn.offset) > _TURN_OFFSET else 0.0,
    )
    if strength < 1:
        return []
    size = max(abs(turn.mean), turn.smooth)
    words = f"the images are rotated relative to the volume, by at least {size:.2f} pixels at their edge: the tilt axis is wrong"
    return [Finding("axis", strength, words, "give --tilt-axis, or use --refine-alignment")]


def _beam(found: dict[str, Distortion]) -> list[Finding]:
    strengths = {name: _strength(found[name], _BRIGHT, _BRIGHT) for name in ("brightness", "background")}
    name = max(strengths, key=lambda each: strengths[each])
    if strengths[name] < 1:
        return []
    size = max(found[name].size, found[name].smooth)
    words = f"the {name} changes from tilt to tilt by {size:.0%} of the contrast relative to the volume"
    return [Finding("beam", strengths[name], words, "normalise the images by their incident beam, or check the mode")]


def _as_dict(one: Distortion) -> dict[str, float]:
    names = ("size", "smooth", "rough", "mean", "scatter", "trend", "offset")
    return {name: float(getattr(one, name)) for name in names}
