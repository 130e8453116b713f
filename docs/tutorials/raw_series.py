"""The pictures of docs/tutorials/raw_series.md, from the raw series, the volume and what the command printed.

noiseflow reconstruct needle_256_raw.mrc -o needle.mrc --mode linear --refine-alignment --json > needle.json
python docs/tutorials/raw_series.py needle_256_raw.mrc needle.mrc needle.json docs/images
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.report import new_figure, show_image
from recon.metrics.comparison import project
from recon.series.alignment import Alignment
from recon.series.files import read_tilt_series
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]


def draw_alignment(raw: TiltSeries, aligned: TiltSeries, alignment: Alignment, path: Path) -> None:
    """Three raw images with the tilt axis that was found, and one line of pixels across the axis at all tilts."""
    figure, axes = new_figure(5, width=16, height=3.4)
    theta, (_, height, width) = np.deg2rad(alignment.tilt_axis), raw.images.shape
    for axis, number in zip(axes[0], (0, raw.num_tilts // 2, raw.num_tilts - 1), strict=False):
        show_image(axis, raw.images[number], f"raw, {raw.tilt_angles[number]:.0f}°")
        down, right = (np.array([height, width]) - 1) / 2 + alignment.shifts[number]
        reach = 0.45 * width * np.array([-1, 1])
        axis.plot(right - reach * np.sin(theta), down + reach * np.cos(theta), color="#E69F00", linewidth=1)
    show_image(axes[0, 3], raw.images[:, :, width // 2], "raw: one column, tilt by tilt")
    show_image(axes[0, 4], aligned.images[:, aligned.images.shape[1] // 2], "aligned: one row, tilt by tilt")
    _save(figure, path)


def draw_volume(aligned: TiltSeries, volume: Array, offset: float, path: Path) -> None:
    """Three slices through the middle, and one image with its projection and what is left."""
    depth, height, width = volume.shape
    figure, axes = new_figure(3, rows=2, width=12, height=3.8)
    limits = (0.0, float(np.quantile(volume, 0.9995)))
    show_image(axes[0, 0], volume[depth // 2], "volume, slice (y, x)", limits=limits)
    show_image(axes[0, 1], volume[:, height // 2], "volume, slice (z, x)", limits=limits)
    show_image(axes[0, 2], volume[:, :, width // 2], "volume, slice (z, y)", limits=limits)
    number = aligned.num_tilts // 2
    image = np.where(aligned.used[number], aligned.images[number] - offset, 0)
    projection = project(volume, aligned.tilt_angles[[number]])[0]
    left = np.where(aligned.used[number], image - projection, 0)
    show_image(axes[1, 0], image, f"aligned image, {aligned.tilt_angles[number]:.0f}°")
    show_image(axes[1, 1], projection, "projection of the volume")
    show_image(
        axes[1, 2], left, "what is left: ± 5 % of the range", limits=(-0.05 * np.ptp(image), 0.05 * np.ptp(image))
    )
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    with io.atomic_path(path) as partial:
        figure.savefig(partial, dpi=60, facecolor="white")


def main(raw_file: str, volume_file: str, summary_file: str, folder: str) -> None:
    """Draw both pictures and print the verdict."""
    raw = read_tilt_series(raw_file, mode="linear")
    summary = json.loads(Path(summary_file).read_text(encoding="utf-8").strip().splitlines()[-1])
    found = summary["alignment"]
    alignment = Alignment(found["tilt_axis_degrees"], np.array(found["shifts_yx_pixels"]), raw.tilt_angles)
    aligned = alignment.apply(raw)
    draw_alignment(raw, aligned, alignment, Path(folder) / "raw_series_alignment.png")
    volume = io.read(volume_file).data
    draw_volume(aligned, volume, float(np.mean(summary["response"]["offset"])), Path(folder) / "raw_series_volume.png")
    print(summary["verdict"]["grade"], *summary["verdict"]["reasons"], sep="\n  - ")


if __name__ == "__main__":
    main(*sys.argv[1:5])
