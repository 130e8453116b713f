"""Camera calibration from flats and darks: EMVA 1288 figures, their verdict, per-pixel maps and a noise model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.emva import CameraFigures, measure_camera
from calibration.detector.posterior import Interval
from calibration.exposures.frames import Burst, Image, rounding_step
from calibration.exposures.processing import deviations
from calibration.tolerances import CERTAIN, CLEAR
from calibration.verdict import CalibrationCase, judge, said
from noiseflow.checks import Verdict
from noiseflow.described import described

if TYPE_CHECKING:
    from torch import nn

EXCESS = 1.2
"""Smallest excess-noise factor F² of a detector that multiplies electrons: direct detectors and EMCCDs have 1.4 to 2."""

MAPS = ("response", "gain", "offset", "variance", "defects")
"""Names of the maps; offset and variance require dark frames."""


@described()
@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    Attributes:
        figures: EMVA 1288 figures; the gain is the one before any filter.
        verdict: their reliability.
        maps: (y, x) arrays by name: ``offset`` in counts, ``variance`` in darkness in counts², relative ``response``, ``gain`` in
            counts per electron (assuming equal quantum efficiency), ``defects``, 1 for an outlier pixel.
        model: noise model with the maps of offset, response and, where the dark frames determine it, read-noise variance.
    """

    figures: CameraFigures
    verdict: Verdict
    maps: dict[str, Image]
    model: nn.Module


def calibrate_camera(
    flats: Sequence[Burst],
    darks: Sequence[Burst] = (),
    *,
    flat_times: Sequence[float] | None = None,
    dark_times: Sequence[float] | None = None,
) -> Camera:
    """Calibrate a camera; see `measure_camera` for arguments and errors."""
    measured = measure_camera(flats, darks, flat_times=flat_times, dark_times=dark_times)
    figures = _before_filter(measured)
    maps = maps_of(figures)
    return Camera(figures, judge_camera(figures), maps, model_of(measured, maps, rounding_step(flats[0].frames[0])))


def judge_camera(figures: CameraFigures) -> Verdict:
    """Test the assumptions behind the figures."""
    return judge(CalibrationCase(figures.correlation, camera=figures))


def maps_of(figures: CameraFigures) -> dict[str, Image]:
    """Return the per-pixel maps, each (y, x); without dark frames no ``offset`` and ``variance``."""
    response = figures.response
    maps = {"response": response, "gain": figures.gain.median * response}
    if figures.dark is not None:
        maps |= {"offset": figures.dark.image, "variance": figures.dark.noise}
    maps["defects"] = _defects(maps, figures).astype(float)
    return maps


def model_of(figures: CameraFigures, maps: dict[str, Image], step: float) -> nn.Module:
    """Return the noise model of raw frames: the average pixel's model with the maps of offset, response and read-noise variance.

    The model's signals are those of an average pixel. Values that the maps cannot represent, such as pixels without response, are
    clipped. A detector that multiplies electrons reads all pixels through one amplifier and therefore has no variance map.
    """
    import noiseflow

    offset = figures.offset or 0.0
    read = figures.dark_noise.median if figures.dark_noise else 1.0
    excess, variance = figures.excess_factor, read_variance(figures, step)
    if excess is not None and excess.q05 > EXCESS:
        variance = None
        register_gain = figures.gain.median / excess.median
        inner: nn.Module = noiseflow.ExcessNoise(
            register_gain, offset, read * figures.gain.median / register_gain, excess_factor=excess.median
        )
    else:
        inner = noiseflow.PoissonGaussian(figures.gain.median, offset, max(read, 1e-3))
    end = min(level.end for level in figures.levels)
    digitised = noiseflow.Digitised(inner, step=step, high=end) if step or np.isfinite(end) else inner
    response = np.clip(maps["response"], 0.01, None)
    return noiseflow.WithMaps(
        digitised,
        gain=response,
        offset=maps.get("offset", np.full(response.shape, offset)) - response * offset,
        variance=variance,
    )


def read_variance(figures: CameraFigures, step: float) -> Image | None:
    """Estimate the read-noise variance of every pixel, (y, x) counts², by empirical Bayes (doi:10.2202/1544-6115.1027).

    A variance estimated from few frames scatters even if all pixels are equal. The excess scatter of its logarithm determines a
    scaled inverse χ² prior. The result is the inverse of the posterior mean of 1/variance; its average is slightly below that of
    the variances.

    Args:
        figures: figures of the camera.
        step: rounding step, counts; its variance is not part of the read noise.

    Returns:
        The map, or None if the pixels do not differ, rounding hides the variance, or there are no dark frames.
    """
    from scipy.optimize import brentq
    from scipy.special import digamma, polygamma

    dark = figures.dark
    if dark is None or dark.coarse:
        return None
    freedom, drift = dark.frames - 1, max(float(dark.noise.mean()) - dark.variance, 0.0)
    measured = np.maximum(dark.noise - drift, max(step**2 / 12, 1e-6 * dark.variance))
    logarithm = np.log(measured) - digamma(freedom / 2) + np.log(freedom / 2)
    own = float(polygamma(1, freedom / 2))
    tails = float(polygamma(3, freedom / 2)) / own**2  # excess kurtosis of the logarithm
    excess, error = float(np.var(logarithm)) - own, own * np.sqrt((2 + tails) / measured.size)
    if excess < CLEAR * error:
        return None
    prior = 2 * brentq(lambda half: float(polygamma(1, half)) - excess, 1e-3, 2 / excess + 1)
    usual = float(np.exp(logarithm.mean() + digamma(prior / 2) - np.log(prior / 2)))
    whole = (prior * usual + freedom * measured) / (prior + freedom)
    error = whole * np.sqrt(2 / (prior + freedom))  # of which none is known to be less
    return np.asarray(np.maximum(whole - step**2 / 12, np.minimum(error, whole)))


def map_path(model: Path, name: str) -> Path:
    """Return the path of a map, one of `MAPS`, next to the model file."""
    return model.with_name(f"{model.stem}_{name}.tif")


def write_maps(camera: Camera, model: Path) -> list[Path]:
    """Write each map as a 32-bit TIFF next to the model file, and return the paths."""
    from noiseflow.io import write

    paths = []
    for name, image in camera.maps.items():
        path = map_path(model, name)
        write(path, image.astype(np.float32))
        paths.append(path)
    return paths


def rows_of(camera: Camera) -> list[tuple[str, str]]:
    """Return the figures as (name, formatted value)."""
    figures = camera.figures
    gain, per_count = figures.gain, 1 / figures.gain.median
    rows = [
        (
            "system gain K",
            f"{gain.median:.5g} counts/e⁻ (90 %: {gain.q05:.5g} … {gain.q95:.5g}); 1/K = {per_count:.5g} e⁻/count",
        ),
        ("K for a linear response", _text(figures.if_linear, "counts/e⁻")),
        ("dark noise", _text(figures.dark_noise, "e⁻ rms")),
        ("offset", _value(figures.offset, "counts")),
        ("saturation capacity", ("" if figures.saturated else "≥ ") + f"{figures.saturation:.5g} e⁻"),
        (
            "dynamic range",
            "not determined"
            if figures.dynamic_range is None
            else ("" if figures.saturated else "≥ ")
            + f"{figures.dynamic_range:.4g} ({20 * np.log10(figures.dynamic_range):.1f} dB)",
        ),
        ("maximum SNR", f"{figures.snr_maximum:.4g} ({20 * np.log10(figures.snr_maximum):.1f} dB)"),
        (
            "linearity error",
            "not determined (give --flat-time)"
            if figures.linearity_error is None
            else f"{100 * figures.linearity_error:.3g} %",
        ),
        ("DSNU", _value(figures.dsnu, "e⁻ rms")),
        ("PRNU", "not determined" if figures.prnu is None else f"{100 * figures.prnu:.3g} %, illumination included"),
        (
            "dark current",
            _value(figures.dark_current, "e⁻/s") + ("" if figures.dark_current is not None else " (give --dark-time)"),
        ),
        ("excess-noise factor F²", _text(figures.excess_factor, "")),
        (
            "exponent of the response",
            f"{figures.bend.exponent:.4g} ± {figures.bend.error:.2g}" if figures.bend.known else _value(None, ""),
        ),
        ("outliers of single frames", f"{figures.outliers}, excluded"),
        ("defective pixels", f"{int(camera.maps['defects'].sum())}"),
    ]
    return [(name, text.strip()) for name, text in rows]


def summary_of(camera: Camera) -> dict[str, Any]:
    """Return the figures as plain values."""
    figures = camera.figures
    names = "offset saturation saturated dynamic_range snr_maximum linearity_error dsnu prnu dark_current rows columns"
    found: dict[str, Any] = {name: getattr(figures, name) for name in names.split()}
    intervals = {name: name for name in ("gain", "dark_noise", "excess_factor")} | {"gain_if_linear": "if_linear"}
    for name, attribute in intervals.items():
        value = getattr(figures, attribute)
        found[name] = None if value is None else vars(value)
    found["electrons_per_count"] = 1 / figures.gain.median
    found["correlation_factor"] = figures.correlation.factor
    zero = figures.offset or 0.0
    found["snr_curve"] = [
        {
            "electrons": (level.mean - zero) / figures.gain.median,
            "snr": (level.mean - zero) / float(np.sqrt(level.variance)),
        }
        for level in figures.levels
        if level.variance > 0
    ]
    found["response"] = {name: getattr(figures.bend, name) for name in ("exponent", "error", "known")}
    found["outliers"] = figures.outliers
    found["defects"] = int(camera.maps["defects"].sum())
    return said(camera.verdict) | {"camera": found}


def _before_filter(figures: CameraFigures) -> CameraFigures:
    """Return the figures before a mean-preserving filter, if the correlation shows one."""
    correlation: Correlation = figures.correlation
    if not (correlation.found and correlation.local and correlation.factor > 3 * correlation.factor_error):
        return figures
    factor = correlation.factor

    def over(value: float | None) -> float | None:
        return None if value is None else value / factor

    return replace(
        figures,
        gain=figures.gain.times(factor),
        if_linear=figures.if_linear.times(factor),
        dark_noise=None if figures.dark_noise is None else figures.dark_noise.times(1 / np.sqrt(factor)),
        saturation=figures.saturation / factor,
        dsnu=over(figures.dsnu),
        dark_current=over(figures.dark_current),
    )


def _defects(maps: dict[str, Image], figures: CameraFigures) -> Image:
    """Pixels whose offset, response or logarithm of the variance is `CERTAIN` robust standard deviations off the median."""
    off = [np.abs(deviations(maps[name])) for name in ("response", "offset") if name in maps]
    if figures.dark is not None and not figures.dark.coarse:
        # above it only: few frames give many pixels a small variance by chance
        off.append(deviations(np.log(np.maximum(maps["variance"], 1e-6 * figures.dark.variance))))
    return np.asarray(np.max(off, axis=0) > CERTAIN)


def _text(value: Interval | None, unit: str) -> str:
    return "not determined" if value is None else f"{value.median:.4g} {unit} (90 %: {value.q05:.4g} … {value.q95:.4g})"


def _value(value: float | None, unit: str) -> str:
    return "not determined" if value is None else f"{value:.4g} {unit}"
