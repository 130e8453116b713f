"""Camera calibration from flats and darks: EMVA 1288 figures, their verdict, per-pixel maps and a noise model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its packages load when they are first used
from torch import nn

import noiseflow
from calibration.detector.emva import CameraFigures, measure_camera
from calibration.detector.posterior import Interval
from calibration.exposures.frames import Burst, Image, rounding_step
from calibration.exposures.processing import deviations
from calibration.tolerances import CERTAIN, CLEAR, EXCESS
from calibration.verdict import CalibrationCase, judge
from noiseflow import io
from noiseflow.checks import Verdict
from noiseflow.described import described
from noiseflow.statistics import uniform_variance

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
    response, dark = figures.response, darks[0] if darks else None
    maps = {"response": response, "gain": figures.gain.median * response}
    if figures.dark is not None:
        maps |= {"offset": figures.dark.image, "variance": figures.dark.noise}
    maps["defects"] = _defects(maps, figures).astype(float)
    verdict = judge(CalibrationCase(figures.correlation, flat=flats[0], dark=dark, camera=figures))
    return Camera(figures, verdict, maps, model_of(measured, maps, rounding_step(flats[0].frames[0])))


def model_of(figures: CameraFigures, maps: dict[str, Image], step: float) -> nn.Module:
    """Return the noise model of raw frames: the average pixel's model with the maps of offset, response and read-noise variance.

    The model's signals are those of an average pixel. Values that the maps cannot represent, such as pixels without response, are
    clipped. A detector that multiplies electrons reads all pixels through one amplifier and therefore has no variance map.
    """
    offset, dark = figures.offset or 0.0, figures.dark
    read = np.sqrt(max(dark.variance, 0.0)) / figures.gain.median if dark else 1.0
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
        step: rounding step, counts; its variance is not part of the read noise.

    Returns:
        The map, or None if the pixels do not differ, rounding hides the variance, or there are no dark frames.
    """
    digamma, polygamma, dark = scipy.special.digamma, scipy.special.polygamma, figures.dark
    if dark is None or dark.coarse:
        return None
    freedom, drift = dark.frames - 1, max(float(dark.noise.mean()) - dark.variance, 0.0)
    measured = np.maximum(dark.noise - drift, max(uniform_variance(step), 1e-6 * dark.variance))
    logarithm = np.log(measured) - digamma(freedom / 2) + np.log(freedom / 2)
    own = float(polygamma(1, freedom / 2))
    tails = float(polygamma(3, freedom / 2)) / own**2  # excess kurtosis of the logarithm
    excess, error = float(np.var(logarithm)) - own, own * np.sqrt((2 + tails) / measured.size)
    if excess < CLEAR * error:
        return None
    prior = 2 * scipy.optimize.brentq(lambda half: float(polygamma(1, half)) - excess, 1e-3, 2 / excess + 1)
    usual = float(np.exp(logarithm.mean() + digamma(prior / 2) - np.log(prior / 2)))
    whole = (prior * usual + freedom * measured) / (prior + freedom)
    error = whole * np.sqrt(2 / (prior + freedom))  # of which none is known to be less
    return np.asarray(np.maximum(whole - uniform_variance(step), np.minimum(error, whole)))


def map_path(model: Path, name: str) -> Path:
    """Return the path of a map, one of `MAPS`, next to the model file."""
    return model.with_name(f"{model.stem}_{name}.tif")


def write_maps(camera: Camera, model: Path) -> list[Path]:
    """Write each map as a 32-bit TIFF next to the model file, and return the paths."""
    for name, image in camera.maps.items():
        io.write(map_path(model, name), image.astype(np.float32))
    return [map_path(model, name) for name in camera.maps]


@dataclass(frozen=True)
class Figure:
    """One figure of a detector.

    Attributes:
        name, symbol: its name, and its symbol in EMVA 1288; empty if the standard has none.
        value: its value in `unit`; None if it was not determined.
        low, high: 90 % interval; None if unknown.
        note: what to know about it.
    """

    name: str
    symbol: str
    unit: str
    value: float | None
    low: float | None = None
    high: float | None = None
    note: str = ""

    @classmethod
    def of(cls, name: str, symbol: str, unit: str, value: Interval | None, note: str = "") -> Figure:
        """A figure with its 90 % interval."""
        if value is None or not np.isfinite(value.median):
            return cls(name, symbol, unit, None, note=note)
        return cls(name, symbol, unit, value.median, value.q05, value.q95, note)

    @property
    def row(self) -> tuple[str, str]:
        """Name with symbol, and `text`."""
        return f"{self.name} {self.symbol}".strip(), self.text

    @property
    def text(self) -> str:
        """Value, unit, interval and note."""
        shown = "not determined" if self.value is None else f"{self.value:.5g} {self.unit}".strip()
        more = "" if self.low is None else f" (90 %: {self.low:.4g} … {self.high:.4g})"
        return (shown + more + (f"; {self.note}" if self.note else "")).replace("e-", "e⁻")


def figures_of_camera(camera: Camera) -> list[Figure]:
    """The EMVA 1288 figures of flats and darks."""
    found, current = camera.figures, camera.figures.dark_current
    bend = Interval.normal(found.bend.exponent, found.bend.error) if found.bend.known else None
    linearity, prnu = (None if one is None else 100 * one for one in (found.linearity_error, found.prnu))
    bound = "" if found.saturated else "a lower bound"
    decibels = [f"{20 * np.log10(one):.1f} dB" if one else "" for one in (found.dynamic_range, found.snr_maximum)]
    return [
        Figure.of("system gain", "K", "counts/e-", found.gain, f"1/K = {1 / found.gain.median:.5g} e-/count"),
        Figure.of("system gain, linear response", "", "counts/e-", found.if_linear),
        Figure.of("temporal dark noise", "σ_d", "e- rms", found.dark_noise),
        Figure("offset", "μ_y.dark", "counts", found.offset),
        Figure("saturation capacity", "μ_e.sat", "e-", found.saturation, note=bound),
        Figure("dynamic range", "DR", "", found.dynamic_range, note=", ".join(filter(None, (decibels[0], bound)))),
        Figure("maximum signal-to-noise ratio", "SNR_max", "", found.snr_maximum, note=decibels[1]),
        Figure("linearity error", "LE", "%", linearity, note="give --flat-time" if linearity is None else ""),
        Figure("dark-signal nonuniformity", "DSNU_1288", "e- rms", found.dsnu),
        Figure("photo-response nonuniformity", "PRNU_1288", "%", prnu, note="illumination included"),
        Figure("dark current", "μ_I", "e-/s", current, note="give --dark-time" if current is None else ""),
        Figure.of("excess-noise factor", "", "", found.excess_factor),
        Figure.of("exponent of the response", "", "", bend),
        Figure("outliers of single frames", "", "", found.outliers, note="excluded"),
        Figure("defective pixels", "", "", float(camera.maps["defects"].sum())),
    ]


def summary_of(camera: Camera) -> dict[str, Any]:
    """Return the figures as plain values."""
    figures = camera.figures
    names = "offset saturation saturated dynamic_range snr_maximum linearity_error dsnu prnu dark_current rows columns"
    found: dict[str, Any] = {name: getattr(figures, name) for name in names.split()}
    intervals = {name: name for name in ("gain", "dark_noise", "excess_factor")} | {"gain_if_linear": "if_linear"}
    values = {name: getattr(figures, attribute) for name, attribute in intervals.items()}
    found |= {name: None if value is None else vars(value) for name, value in values.items()}
    found |= {"electrons_per_count": 1 / figures.gain.median, "correlation_factor": figures.correlation.factor}
    zero = figures.offset or 0.0
    signals = [(level.mean - zero, float(np.sqrt(level.variance))) for level in figures.levels if level.variance > 0]
    found["snr_curve"] = [{"electrons": one / figures.gain.median, "snr": one / noise} for one, noise in signals]
    found["response"] = {name: getattr(figures.bend, name) for name in ("exponent", "error", "known")}
    found |= {"outliers": figures.outliers, "defects": int(camera.maps["defects"].sum())}
    return {"verdict": camera.verdict.as_dict(), "camera": found}


def _before_filter(figures: CameraFigures) -> CameraFigures:
    """Return the figures before a mean-preserving filter, if the correlation shows one."""
    if not figures.correlation.filtered:
        return figures
    factor, names = figures.correlation.factor, ("saturation", "dsnu", "dark_current")
    less = {name: value / factor for name in names if (value := getattr(figures, name)) is not None}
    dark_noise = None if figures.dark_noise is None else figures.dark_noise.times(1 / np.sqrt(factor))
    gain, linear = (one.times(factor) for one in (figures.gain, figures.if_linear))
    return replace(figures, gain=gain, if_linear=linear, dark_noise=dark_noise, **less)


def _defects(maps: dict[str, Image], figures: CameraFigures) -> Image:
    """Pixels whose offset, response or logarithm of the variance is `CERTAIN` robust standard deviations off the median."""
    off = [np.abs(deviations(maps[name])) for name in ("response", "offset") if name in maps]
    if figures.dark is not None and not figures.dark.coarse:
        # above it only: few frames give many pixels a small variance by chance
        off.append(deviations(np.log(np.maximum(maps["variance"], 1e-6 * figures.dark.variance))))
    return np.asarray(np.max(off, axis=0) > CERTAIN)
