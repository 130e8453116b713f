"""Charts of the calibration report."""

from collections.abc import Sequence

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.figures import Figures
from calibration.detector.measure import Detector
from calibration.detector.models import ModelScore, Pixels
from calibration.exposures.frames import Image
from calibration.exposures.scaling import smoothed
from calibration.registration.aligned import AlignedPair
from noiseflow.arrays import strided
from noiseflow.report import COLOURS, STYLES, Chart, grey_range, residual_histogram

PARAMETERS = ("gain, counts/e⁻", "offset, counts", "read noise, e⁻ rms")


def image_chart(
    image: Image, title: str, *, limits: tuple[float, float] | None = None, shape: tuple[int, ...] = ()
) -> Chart:
    """Draw a (y, x) image in grey over `grey_range` or between `limits`, or an (y, x, 3) one from 0 to 1, `strided`; its axes are
    those of an image of `shape` if given."""
    height, width = shape or image.shape[:2]
    image = strided(image, 512)  # more than the width of the drawing
    low, high = limits or ((0.0, 1.0) if image.ndim == 3 else grey_range(image))
    share = np.clip((image - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    x = "x, px" if image.ndim == 3 else f"x, px; grey: {low:.4g} to {high:.4g}"
    chart = Chart(title, x=x, y="y, px", width=3.4, height=0.9 + 2.6 * height / width)
    chart.image(np.round(255 * share).astype(np.uint8), box=(0.0, float(width), float(height), 0.0))
    chart.limits = {"x": (0.0, float(width)), "y": (float(height), 0.0)}
    return chart


def registration_charts(pair: AlignedPair) -> list[Chart]:
    """Draw the short (magenta) and long (green) exposures on top of each other, before and after registration."""
    short, long, signal = (strided(each, 512) for each in (pair.short, pair.long, pair.signal))
    charts = []
    for image, when in ((pair.scaling.slope * long + pair.scaling.intercept, "Before"), (signal, "After")):
        low, high = grey_range(image)
        red, green = (np.clip((each - low) / max(high - low, np.finfo(float).tiny), 0, 1) for each in (short, image))
        charts.append(image_chart(np.stack([red, green, red], -1), f"{when} registration", shape=pair.short.shape))
    return charts


def residual_charts(pair: AlignedPair) -> list[Chart]:
    """Draw the smoothed residual, and the row and column means of the residual with ±2 standard errors."""
    residual = pair.residual.z
    blurred = 6 * np.sqrt(np.pi) * smoothed(residual, 3.0)  # of unit variance for white noise
    charts = [image_chart(blurred, "Residual smoothed over 3 px, s.d.", limits=(-4.0, 4.0))]
    for along, name in ((1, "row"), (0, "column")):
        error = 2 / np.sqrt(np.maximum(pair.mask.sum(axis=along), 1))
        chart = Chart(f"Mean residual of each {name} (grey: ±2 s.e.)", x=f"{name}, px", y="standard deviations")
        place = np.arange(error.size)
        chart.fill(place, -error, error, colour=COLOURS["data"], opacity=0.5)
        chart.plot(place, residual.sum(axis=along) * error**2 / 4, width=0.8)
        most = 5 * float(np.median(error))
        chart.limits["y"] = -most, most
        charts.append(chart)
    return charts


def histogram_charts(pixels: Pixels, scores: Sequence[ModelScore]) -> list[Chart]:
    """Draw histograms of the residuals of held-out pixels at several signal levels, with the densities of the models."""
    signal, observation = pixels.signal[pixels.held_out], pixels.observation[pixels.held_out]
    models = {score.label: score.model for score in scores}
    return [
        residual_histogram(signal[group], observation[group], models, unit="counts", legend=number == 0)
        for number, group in enumerate(np.array_split(np.argsort(signal), 6))
    ]


def pit_charts(scores: Sequence[ModelScore]) -> list[Chart]:
    """Draw the probability integral transform of held-out pixels, which is uniform for a correct model, and its QQ plot."""
    pit = Chart("PIT (grey: ±2 s.e.)", x="probability integral transform", y="density")
    quantiles = Chart("QQ (grey: 95 % of samples)", x="expected probability", y="observed − expected")
    judged = scores[0].evaluation
    error, ends = 2 * np.sqrt((len(judged.pit) + 1) / judged.num_pixels), np.array([0.0, 1.0])
    for chart, middle, away in ((pit, 1.0, error), (quantiles, 0.0, judged.ks_floor)):
        band = np.full(2, away)
        chart.fill(ends, middle - band, middle + band, colour=COLOURS["data"], opacity=0.5)
    for score, (colour, dashes) in zip(scores, STYLES, strict=False):
        density = np.asarray(score.evaluation.pit)
        edges = np.linspace(0, 1, len(density) + 1)
        pit.stairs(density, edges, colour=colour, label=score.label)
        below = np.concatenate([[0], np.cumsum(density)]) / len(density)
        quantiles.plot(edges, below - edges, colour=colour, dashes=dashes)
    return [pit, quantiles]


def photon_transfer_charts(detector: Detector) -> list[Chart]:
    """Draw variance against signal with the posterior's 90 % band, and the deviation from the fitted line."""
    line = detector.line
    signal = np.linspace(min(line.signal.min(), detector.posterior.offset.median), line.signal.max(), 100)
    gain, offset, read_noise = detector.posterior.samples[:, :, None].transpose(1, 0, 2)
    variance = gain * np.maximum(signal - offset, 0) + (gain * read_noise) ** 2
    low, high = np.percentile(variance, (5, 95), axis=0)
    transfer = Chart("Photon transfer", x="signal, counts", y="variance, counts²")
    transfer.fill(signal, low, high, opacity=0.3, label="posterior, 90 %")
    transfer.plot(
        signal, line.gain * signal + line.intercept, dashes="5 3", colour=COLOURS["soft"], label="fitted line"
    )
    points = line.signal, line.variance, line.variance_error
    return [transfer, deviation_chart(transfer, *points, line.gain, line.intercept)]


def deviation_chart(
    transfer: Chart, signal: Image, variance: Image, error: Image, gain: float, intercept: float
) -> Chart:
    """Draw measured variances on a photon-transfer chart, and return the chart of their deviations from a line."""
    expected = gain * signal + intercept
    transfer.plot(signal, variance, width=0, dots=2, error=error, colour=COLOURS["warm"], label="levels (±1 s.e.)")
    chart = Chart("Deviation from the line", x="signal, counts", y="%")
    percent = 100 * (variance / expected - 1), 100 * np.abs(error / expected)
    chart.plot(signal, percent[0], width=0, dots=2, error=percent[1], colour=COLOURS["warm"])
    chart.line(y=0.0, colour=COLOURS["soft"])
    return chart


def correlation_charts(correlation: Correlation) -> list[Chart]:
    """Draw the correlation of residuals as a map over (x, y) distance, and along both axes with its standard error."""
    reach = int(np.abs(correlation.lags).max())
    image = np.zeros((2 * reach + 1, 2 * reach + 1))
    for (dy, dx), value in zip(correlation.lags.astype(int), correlation.value, strict=True):
        image[reach + dy, reach + dx] = image[reach - dy, reach - dx] = value
    limit = max(float(np.abs(image).max()), 5 * float(correlation.error.max()))
    area = image_chart(image, "Correlation by distance", limits=(-limit, limit))
    ticks = [(reach + step + 0.5, f"{step}") for step in range(-reach, reach + 1, 2)]
    area.ticks = {"x": ticks, "y": ticks}
    chart = Chart("Correlation along the axes", x="distance, px", y="correlation")
    error, steps = np.full(2, 2 * float(correlation.error.max())), np.arange(1, reach + 1)
    chart.fill([1, reach], -error, error, colour=COLOURS["data"], opacity=0.5, label="±2 s.e.")
    for name, colour, lag in (("along x", "accent", (0, 1)), ("along y", "warm", (1, 0))):
        values = [correlation.at(lag[0] * int(step), lag[1] * int(step)) for step in steps]
        chart.plot(steps, values, dots=2, colour=COLOURS[colour], label=name)
    return [area, chart]


def snr_chart(electrons: Image, ratio: Image) -> Chart:
    """Draw the signal-to-noise ratio of a pixel against its number of electrons."""
    chart = Chart("Signal-to-noise ratio of a pixel", x="electrons", y="signal-to-noise ratio", log="xy")
    electrons, ratio = np.stack([electrons, ratio])[:, np.argsort(electrons)]
    chart.plot(electrons, ratio, label="this detector")
    chart.plot(electrons, np.sqrt(electrons), dashes="5 3", colour=COLOURS["soft"], label="shot-noise limit")
    return chart


def snr_of(figures: Figures, brightest: float) -> Chart:
    """Draw the signal-to-noise ratio up to a signal, counts."""
    offset, read = figures.offset, figures.read_noise
    most = max((brightest - (offset.median if offset else 0.0)) / figures.gain.median, 10.0)
    electrons = np.geomspace(0.1, most, 200)
    return snr_chart(electrons, electrons / np.sqrt(electrons + (read.median**2 if read else 0.0)))


def corner_charts(detector: Detector) -> list[Chart]:
    """Draw the posterior of each pair of parameters."""
    charts = []
    for first, second in ((0, 1), (0, 2), (1, 2)):
        samples = detector.posterior.samples
        counts, x, y = np.histogram2d(samples[:, first], samples[:, second], bins=50)
        shade = np.round(255 * (1 - counts.T[::-1] / counts.max())).astype(np.uint8)
        chart = Chart("Posterior", x=PARAMETERS[first], y=PARAMETERS[second], width=3.4)
        chart.image(shade, box=(float(x[0]), float(x[-1]), float(y[0]), float(y[-1])))
        charts.append(chart)
    return charts
