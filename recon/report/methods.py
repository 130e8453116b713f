"""The methods paragraph of a reconstruction, to paste into a paper."""

from __future__ import annotations

from noiseflow.checks import Verdict
from noiseflow.installation import library_version
from recon.methods._registry import find_method
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries

_MODES = {"transmission": "bright-field images", "linear": "images of linear contrast (HAADF or EDX)"}
_PAPER = "H. Kniesel et al., Clean Implicit 3D Structure from Noisy 2D STEM Images, CVPR 2022, doi:10.1109/CVPR52688.2022.02018"


def methods_paragraph(tilt_series: TiltSeries, outcome: Reconstruction, verdict: Verdict | None = None) -> str:
    """Sentences with data, method, chosen parameters, grade, version and citation.

    Example:
        >>> import numpy as np, recon
        >>> from recon.report.methods import methods_paragraph
        >>> density = np.zeros((16, 16, 16))
        >>> density[6:10, 6:10, 6:10] = 1.0
        >>> series, unit = recon.clean_tilt_series(density, np.arange(-60, 61, 10.0))
        >>> result = recon.reconstruct(series, method="wbp")
        >>> methods_paragraph(series, result).startswith("A tilt series of 13 bright-field images (16 × 16 pixels, -60° to 60°)")
        True
    """
    count, height, width = tilt_series.images.shape
    angles, shape = tilt_series.tilt_angles, outcome.volume.attenuation.shape
    size = outcome.volume.voxel_size
    chosen = ", ".join(f"{name} {in_words(value)}" for name, value in outcome.choices.items())
    sentences = [
        f"A tilt series of {count} {_MODES[tilt_series.mode]} ({width} × {height} pixels, {angles.min():g}° to "
        f"{angles.max():g}°) was reconstructed with noiseflow {library_version()}, method {outcome.method}",
        f"The volume has {' × '.join(map(str, shape))} voxels (z, y, x)" + (f" of {size:.4g} Å" if size else ""),
    ]
    if chosen:
        sentences.append(f"Chosen and estimated values: {chosen}")
    if verdict is not None:
        reasons = "" if verdict.grade == "good" else f" ({'; '.join(verdict.reasons)})"
        sentences.append(f"The program graded the result {verdict.grade}{reasons}")
    if find_method(outcome.method).learns_noise:
        sentences.append(f"The noise was learnt together with the volume, following {_PAPER}")
    return ". ".join(sentences) + "."


def in_words(value: object) -> str:
    """A setting as text."""
    if value is None or isinstance(value, bool):
        return "yes" if value else "no" if value is False else "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
