"""HTML report of a camera calibrated from flats and darks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.camera import Camera, figures_of_camera
from calibration.report.exports import FILES, write_exports
from calibration.report.figures import correlation_charts, deviation_chart, image_chart, snr_chart
from calibration.report.page import NEXT, interval_line
from noiseflow.report import Chart, Report, add_verdict, provenance


def write_camera_report(
    folder: str | Path, camera: Camera, *, inputs: Sequence[str | Path] = (), seed: int | None = None, listed: int = 50
) -> Path:
    """Write ``report.html`` to a folder, which is created if necessary, and return its path.

    Args:
        folder: output folder.
        camera: the calibrated camera.
        inputs: input files; the report lists their checksums.
        seed: random seed to report.
        listed: largest number of defective pixels in the report.
    """
    page = Report("Camera calibration (EMVA 1288)")

    def figures() -> None:
        page.heading("Figures")
        page.table(("figure", "value"), [one.row for one in figures_of_camera(camera)], prose=True)

    page.columns(lambda: add_verdict(page, camera.verdict, next_step=NEXT), figures)
    page.heading("Photon transfer")
    page.charts(
        transfer_charts(camera),
        caption="Variance with the fitted line; deviation from the line; signal-to-noise ratio of a pixel.",
    )
    page.charts(
        correlation_charts(camera.figures.correlation),
        caption="Correlation of the temporal noise between pixels; independent pixels have zero correlation.",
    )
    page.heading("Per-pixel maps")
    titles = {"offset": "Offset, counts", "variance": "Dark variance, counts²", "response": "Relative response"}
    maps = [image_chart(camera.maps[name], title) for name, title in titles.items() if name in camera.maps]
    page.charts(maps, caption="Per-pixel maps; grey range from the 0.5th to the 99.8th percentile.")
    defects = np.argwhere(camera.maps["defects"] > 0)
    if len(defects):
        caption = f"The first {min(len(defects), listed)} of {len(defects)} defective pixels."
        names = [name for name in titles if name in camera.maps]
        rows = [[f"{y}", f"{x}", *(f"{camera.maps[name][y, x]:.4g}" for name in names)] for y, x in defects[:listed]]
        page.table(("y", "x", *names), rows, caption=caption)
    page.heading("Provenance", folded=True)
    page.table(("item", "value"), provenance(inputs, seed=seed), prose=True)
    saved = page.save(Path(folder) / FILES[0])
    shape, top = camera.maps["response"].shape, min(one.end for one in camera.figures.levels)
    write_exports(folder, figures_of_camera(camera), top=top, shape=shape, verdict=camera.verdict.grade)
    return saved


def intervals_of_camera(camera: Camera) -> str:
    """Gain, dark noise, offset and saturation in one line."""
    found = [("gain", "counts/e⁻", camera.figures.gain), ("dark noise", "e⁻ rms", camera.figures.dark_noise)]
    more = (f"{one.name} {one.text}" for one in figures_of_camera(camera) if one.symbol in ("μ_y.dark", "μ_e.sat"))
    return ", ".join([interval_line(found), *more])


def transfer_charts(camera: Camera) -> list[Chart]:
    """Draw variance against mean with the fitted line, its residual, and signal-to-noise ratio against electrons."""
    figures = camera.figures
    points = [*([figures.dark] if figures.dark else []), *figures.levels]
    mean, variance, error = (
        np.array([getattr(one, name) for one in points]) for name in ("mean", "variance", "variance_error")
    )
    slope = figures.gain.median / max(figures.correlation.factor, 1e-30)
    base = figures.dark or figures.levels[0]
    intercept = base.variance - slope * base.mean
    transfer = Chart("Photon transfer", x="mean, counts", y="temporal variance, counts²")
    transfer.plot(mean, slope * mean + intercept, label="fitted line")
    electrons = (mean - (figures.offset or 0.0)) / slope
    used = (electrons > 0) & (variance > 0)
    ratio = slope * electrons[used] / np.sqrt(variance[used])
    return [
        transfer,
        deviation_chart(transfer, mean, variance, error, slope, intercept),
        snr_chart(electrons[used], ratio),
    ]
