"""A camera calibrated from flats and darks alone: EMVA 1288 figures, their verdict, per-pixel maps and a noise model."""

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
from calibration.verdict import BIAS, Grade, Reason, Verdict, frames_correlated, verdict_of
from noiseflow.described import described

if TYPE_CHECKING:
    from torch import nn

EXCESS = 1.2
"""F² from which on a detector multiplies electrons: direct detectors and electron-multiplying CCDs have 1.4 to 2."""

LARGEST_CHI_SQUARED = 4.0
"""χ² per degree of freedom of the photon-transfer line above which it is bent."""

STEADY = 0.003
"""Relative change of the light between equal frames that needs no warning."""

LEAST_FRAMES = 8
"""Frames from which on a pixel's own variance is known to a factor of 1.5, so that a map of it tells something."""

SURE = 10.0
"""Standard errors by which the pixels' variances must differ: the logarithm of a variance of two frames has heavier tails than
that error allows for."""

COARSE = 0.5
"""Rounding steps of read noise below which the variance of rounded values depends by over 3 % on where between two codes a
pixel's mean lies, so that the pixels would differ though their noise does not."""

LEAST_READ = 0.01
"""Share of the usual variance below which no pixel's read noise is put: rounding hides less."""

MAPS = ("response", "gain", "offset", "variance", "defects")
"""Names of the maps; offset and variance need dark frames."""


@described()
@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    Attributes:
        figures: what EMVA 1288 reports, the gain before any filter.
        verdict: how far they can be believed.
        maps: (y, x) by name: ``offset`` counts, ``variance`` counts² in darkness, ``response`` relative, ``gain`` counts per
            electron if all pixels catch light alike, ``defects`` 1 where a pixel stands out of all others.
        model: noise model with the maps of offset, response and, where the dark frames tell one, read-noise variance.
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
    """Calibrate a camera. Arguments and errors as `measure_camera`."""
    measured = measure_camera(flats, darks, flat_times=flat_times, dark_times=dark_times)
    figures = _before_filter(measured)
    maps = maps_of(figures)
    return Camera(figures, judge_camera(figures), maps, model_of(measured, maps, rounding_step(flats[0].frames[0])))


def judge_camera(figures: CameraFigures) -> Verdict:
    """Test what the figures assume."""
    found: list[Reason] = []

    def add(name: str, grade: Grade, text: str) -> None:
        found.append(Reason(name, grade, text))

    correlation = figures.correlation
    if correlation.found and (abs(correlation.factor - 1) > BIAS or not correlation.local):
        text = "neighbouring pixels' noise correlates: the frames were filtered, resampled or binned"
        if correlation.local and correlation.factor > 0.5:
            add(
                "correlated pixels",
                "doubtful",
                f"{text}; the gain reported is the one before, {correlation.factor:.3g} times as large.",
            )
        else:
            add("correlated pixels", "bad", f"{text}, or carry row noise or interference. Give raw frames.")
    if correlation.period:
        add(
            "periodic noise",
            "bad",
            f"the noise repeats itself every {correlation.period:.3g} pixels: resampled or compressed. Give raw frames.",
        )
    found += frames_correlated(figures.lag)
    if figures.chi_squared > LARGEST_CHI_SQUARED:
        text = f"variance against signal is no straight line (χ² per degree of freedom {figures.chi_squared:.1f})"
        add("bent line", "doubtful", text + ": light that flickers, or a converter that is not linear.")
    flicker = max(level.flicker for level in figures.levels)
    if flicker > STEADY:
        add(
            "unsteady light",
            "doubtful",
            f"the light changed by {flicker:.1%} between equal frames; its mean was taken out. Use a steadier source.",
        )
    if figures.dark is None:
        add(
            "no dark frames",
            "doubtful",
            "without dark frames offset, dark noise, dynamic range, DSNU and PRNU are not determined.",
        )
    elif figures.dark.clipped:
        text = f"{figures.dark.clipped:.1%} of the dark frames' pixel values lie at the converter's end: offset, dark noise, "
        text += (
            "dynamic range and DSNU are not those of the camera, and the gain is from the flats alone. Raise the offset"
        )
        add("clipped darkness", "doubtful", text + " setting.")
    elif figures.dark.coarse:
        text = "the noise of the dark frames is finer than the converter's codes, which hide it: dark noise and dynamic range"
        add("coarse codes", "doubtful", text + " are not determined. The gain is from the flats alone.")
    number = len(figures.linear)
    if number < 3:
        below = " below saturation" if number < len(figures.levels) else ""
        add(
            "few levels",
            "doubtful",
            f"{number} level{'s' * (number > 1)} of light{below} cannot show a bent line; give three or more.",
        )
    if not figures.saturated:
        add("not saturated", "doubtful", "no level reaches saturation: capacity and dynamic range are lower bounds.")
    return verdict_of([one for one in found if one.name != "not saturated"])


def maps_of(figures: CameraFigures) -> dict[str, Image]:
    """Maps of the pixels; without dark frames, of their response alone."""
    response = figures.response
    maps = {"response": response, "gain": figures.gain.median * response}
    if figures.dark is not None:
        maps |= {"offset": figures.dark.image, "variance": figures.dark.noise}
    maps["defects"] = _defects(maps, figures).astype(float)
    return maps


def model_of(figures: CameraFigures, maps: dict[str, Image], step: float) -> nn.Module:
    """The noise model of raw frames: that of a mean pixel, seen through the maps of offset, response and read-noise variance.

    Its signals are those of a mean pixel; what the maps cannot carry, such as pixels without response, is clipped. A detector
    that multiplies electrons reads all pixels through one amplifier, so that it has no map of variance.
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
    """(y, x) read-noise variance, counts², as well as the dark frames tell it; None where the pixels do not differ, where
    rounding hides it, or without dark frames.

    A variance of few frames scatters by itself. Its logarithm scatters by more where the pixels differ; the scaled inverse χ²
    distribution of that spread is the prior, and the inverse of the posterior mean of 1/variance is returned, whose average is a
    little below that of the variances (doi:10.2202/1544-6115.1027).

    Args:
        figures: of the camera.
        step: of rounding, counts; its variance is not read noise.
    """
    from scipy.optimize import brentq
    from scipy.special import digamma, polygamma

    dark = figures.dark
    if dark is None or dark.variance - step**2 / 12 < (COARSE * step) ** 2:
        return None
    freedom, drift = dark.frames - 1, max(float(dark.noise.mean()) - dark.variance, 0.0)
    measured = np.maximum(dark.noise - drift, max(step**2 / 12, 1e-6 * dark.variance))
    logarithm = np.log(measured) - digamma(freedom / 2) + np.log(freedom / 2)
    own = float(polygamma(1, freedom / 2))
    excess, error = float(np.var(logarithm)) - own, own * np.sqrt(2 / measured.size)
    if excess < SURE * error:
        return None
    prior = 2 * brentq(lambda half: float(polygamma(1, half)) - excess, 1e-3, 2 / excess + 1)
    usual = float(np.exp(logarithm.mean() + digamma(prior / 2) - np.log(prior / 2)))
    whole = (prior * usual + freedom * measured) / (prior + freedom)
    return np.asarray(np.maximum(whole - step**2 / 12, LEAST_READ * usual))


def map_path(model: Path, name: str) -> Path:
    """Where the map of this name, one of `MAPS`, is written: beside the model file."""
    return model.with_name(f"{model.stem}_{name}.tif")


def write_maps(camera: Camera, model: Path) -> list[Path]:
    """Write each map as a 32-bit TIFF beside the model file; returns the paths."""
    from noiseflow.io import write

    paths = []
    for name, image in camera.maps.items():
        path = map_path(model, name)
        write(path, image.astype(np.float32))
        paths.append(path)
    return paths


def rows_of(camera: Camera) -> list[tuple[str, str]]:
    """The figures as names and texts."""
    figures = camera.figures
    gain, per_count = figures.gain, 1 / figures.gain.median
    rows = [
        (
            "system gain K",
            f"{gain.median:.5g} counts/e⁻ (90 %: {gain.q05:.5g} … {gain.q95:.5g}); 1/K = {per_count:.5g} e⁻/count",
        ),
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
        ("largest SNR", f"{figures.snr_maximum:.4g} ({20 * np.log10(figures.snr_maximum):.1f} dB)"),
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
        ("defective pixels", f"{int(camera.maps['defects'].sum())}"),
    ]
    return [(name, text.strip()) for name, text in rows]


def summary_of(camera: Camera) -> dict[str, Any]:
    """The figures as plain values."""
    figures = camera.figures
    names = (
        "offset",
        "saturation",
        "saturated",
        "dynamic_range",
        "snr_maximum",
        "linearity_error",
        "dsnu",
        "prnu",
        "dark_current",
    )
    found: dict[str, Any] = {name: getattr(figures, name) for name in names}
    for name in ("gain", "dark_noise", "excess_factor"):
        value = getattr(figures, name)
        found[name] = None if value is None else {"median": value.median, "q05": value.q05, "q95": value.q95}
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
    found["defects"] = int(camera.maps["defects"].sum())
    return {"verdict": camera.verdict.grade, "reasons": [vars(one) for one in camera.verdict.reasons], "camera": found}


def _before_filter(figures: CameraFigures) -> CameraFigures:
    """The figures with the gain before a filter that keeps the mean, where one is found."""
    correlation: Correlation = figures.correlation
    if not (correlation.found and correlation.local and correlation.factor > 3 * correlation.factor_error):
        return figures
    factor = correlation.factor

    def times(value: Interval, by: float) -> Interval:
        return Interval(value.median * by, value.q05 * by, value.q95 * by)

    gain = times(figures.gain, factor)
    noise = None if figures.dark_noise is None else times(figures.dark_noise, 1 / np.sqrt(factor))
    dsnu = None if figures.dsnu is None else figures.dsnu / factor
    current = None if figures.dark_current is None else figures.dark_current / factor
    return replace(
        figures, gain=gain, dark_noise=noise, saturation=figures.saturation / factor, dsnu=dsnu, dark_current=current
    )


def _defects(maps: dict[str, Image], figures: CameraFigures) -> Image:
    """Pixels that stand out of all others by eight robust standard deviations in offset or response, or by noise tenfold."""
    found = np.zeros(maps["response"].shape, bool)
    for name in ("response", "offset"):
        if name in maps:
            values = maps[name]
            middle = np.median(values)
            spread = 1.4826 * np.median(np.abs(values - middle))
            found |= np.abs(values - middle) > 8 * max(float(spread), np.finfo(float).tiny)
    if figures.dark is not None and figures.dark.frames >= LEAST_FRAMES:
        found |= maps["variance"] > 10 * np.median(maps["variance"])
    return np.asarray(found)


def _text(value: Interval | None, unit: str) -> str:
    return "not determined" if value is None else f"{value.median:.4g} {unit} (90 %: {value.q05:.4g} … {value.q95:.4g})"


def _value(value: float | None, unit: str) -> str:
    return "not determined" if value is None else f"{value:.4g} {unit}"
