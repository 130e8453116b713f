"""Comparison of a volume with a reference: errors of volume and projections, Fourier shell correlation, and figures."""

from dataclasses import asdict, dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from noiseflow.arrays import strided
from noiseflow.io import mapped
from noiseflow.progress import Progress
from noiseflow.report import COLOURS, Chart, Report, grey_range, new_figure, show_image
from noiseflow.statistics import Array, block_means
from recon.fields.fields import COARSE
from recon.metrics.metrics import (
    SCALINGS,
    Errors,
    compare,
    compare_images,
    fourier_shell_correlation,
    matching_line,
    reach_in_words,
    resolution,
)
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import Mode, Volume
from recon.series.views import HARMLESS
from recon.uncertainty.result import ShellBand


@dataclass(frozen=True)
class OtherOrientation:
    """An orientation of a volume that fits a reference much better than the given one.

    Attributes:
        axes: axes of the volume in the order that fits the reference's (z, y, x), such as ``yzx``.
        flipped: axes of the reference along which the volume must then be mirrored.
        correlation, given: correlation of coarse voxels in this orientation, and as given; None if the shapes differ.
    """

    axes: str
    flipped: str
    correlation: float
    given: float | None

    def in_words(self) -> str:
        order = f"with its axes in the order ({', '.join(self.axes)})" if self.axes != "zyx" else ""
        flips = f"mirrored along {' and '.join(self.flipped)}" if self.flipped else ""
        given = "" if self.given is None else f", {self.given:.2f} as given"
        what = " and ".join(filter(None, (order, flips)))
        return f"the volume {what} would fit much better: correlation {self.correlation:.2f}{given}"


def better_orientation(volume: NDArray[Any], reference: NDArray[Any], *, more: float = 0.1) -> OtherOrientation | None:
    """The best of the 48 axis orders and flips if it explains much more of the variance than the given one, as noise and nearly
    symmetric specimens never make it, or if only it has the same shape.

    Args:
        volume, reference: (z, y, x).
        more: share of the variance.
    """
    factor = max(1, -(-max(*volume.shape, *reference.shape) // COARSE))
    first, second = _coarse(volume, factor), _coarse(reference, factor)
    found: dict[tuple[str, str], float] = {}
    for order in permutations(range(3)):
        if tuple(volume.shape[axis] for axis in order) != reference.shape:
            continue
        for flips in product((False, True), repeat=3):
            axes = tuple(axis for axis, flip in enumerate(flips) if flip)
            turned = np.flip(first.transpose(order), axes)
            name = "".join("zyx"[axis] for axis in order), "".join("zyx"[axis] for axis in axes)
            found[name] = float(np.mean(turned * second))
    given = found.get(("zyx", ""))
    if not found:
        return None
    best = max(found, key=lambda name: found[name])
    if given is not None and found[best] ** 2 < max(given, 0.0) ** 2 + more:
        return None
    return OtherOrientation(*best, found[best], given)


def _coarse(volume: NDArray[Any], factor: int) -> NDArray[np.float64]:
    """Block means around the centre, of mean 0 and standard deviation 1."""
    edges = [min(factor, size) for size in volume.shape]
    counts, rests = zip(*map(divmod, volume.shape, edges), strict=True)
    parts = [slice(rest // 2, size - (rest + 1) // 2) for size, rest in zip(volume.shape, rests, strict=True)]
    middle, means = volume[tuple(parts)], np.zeros(counts)
    for row in range(counts[0]):
        slab = np.asarray(middle[row * edges[0] : (row + 1) * edges[0]], dtype=np.float64)
        means[row] = block_means(np.where(np.isfinite(slab), slab, 0), *edges)[0]
    spread = float(means.std())  # before there is a second array
    return np.asarray((means - means.mean()) / (spread or 1.0))


THRESHOLDS = (0.5, 0.143)


@dataclass(frozen=True)
class Comparison:
    """The comparison of a volume with a reference.

    Attributes:
        volume: errors of the volume by scaling (``raw``, ``affine``, ``min-max``).
        projections: errors of projections, image by image; empty if no angles were given.
        frequency, correlation: (N,) Fourier shell correlation, cycles per voxel.
        crossings: threshold → frequency, cycles per voxel.
        expected: correlation with the truth that is expected from the error bars of the volume, if known.
        orientation: a flip or an axis order of the volume that fits much better, if there is one.
    """

    volume: dict[str, Errors]
    projections: dict[str, Errors]
    frequency: Array
    correlation: Array
    crossings: dict[float, float]
    expected: ShellBand | None = None
    orientation: OtherOrientation | None = None

    def as_dict(self) -> dict[str, Any]:
        """JSON-serialisable values."""
        both = {"volume": self.volume, "projections": self.projections}
        errors = {name: {scaling: asdict(e) for scaling, e in part.items()} for name, part in both.items()}
        crossings = {f"fsc_{threshold:g}": value for threshold, value in self.crossings.items()}
        if self.expected is not None:
            errors |= {"fsc_expected": {"low": self.expected.low, "high": self.expected.high}}  # type: ignore[dict-item]
        other = None if self.orientation is None else asdict(self.orientation)
        return errors | crossings | {"frequency": self.frequency, "fsc": self.correlation, "better_orientation": other}


def compare_volumes(
    volume: Volume,
    reference: Volume,
    *,
    tilt_angles: Array | None = None,
    mode: Mode = "linear",
    progress: Progress = lambda task, done, total, note: None,
) -> Comparison:
    """Compare a volume with its reference. Raises ValueError if shapes or voxel sizes differ, voxels are not finite, or the
    reference is constant.

    Args:
        reference: the truth, on the same voxel grid.
        tilt_angles: degrees; projections at these angles are compared too.
        mode: type of the projections: line integrals (``linear``), or exp(−line integral) (``transmission``).
    """
    _check_lattices(volume, reference)
    first, second = volume.attenuation, reference.attenuation
    errors, num_steps = dict[str, Errors](), len(SCALINGS) + 2
    for done, scaling in enumerate(SCALINGS):
        progress("comparing", done + 1, num_steps, f"volumes, {scaling}")
        errors[scaling] = compare(first, second, scaling=scaling)
    projections: dict[str, Errors] = {}
    if tilt_angles is not None:
        progress("comparing", len(SCALINGS) + 1, num_steps, "projections")
        images = [project(array, tilt_angles, mode=mode) for array in (first, second)]
        projections = {scaling: compare_images(images[0], images[1], scaling=scaling) for scaling in SCALINGS}
    progress("comparing", num_steps, num_steps, "shell correlation")
    frequency, correlation = fourier_shell_correlation(first, second)
    crossings = {threshold: resolution(frequency, correlation, threshold) for threshold in THRESHOLDS}
    orientation = better_orientation(first, second)
    return Comparison(errors, projections, frequency, correlation, crossings, orientation=orientation)


def project(volume: Array, tilt_angles: Array, *, mode: Mode = "linear") -> NDArray[np.float32]:
    """Projections (tilt, y, u) of a volume (z, y, x): line integrals, or transmission with an incident intensity of 1."""
    depth, height, width = volume.shape
    images = np.empty((len(tilt_angles), height, width), np.float32)
    rows = max(1, mapped.PART // (4 * depth * width))
    together = max(1, rows // 2)  # tilts, of two weights per voxel, so that the matrix does not grow with their number
    for tilts in (slice(start, start + together) for start in range(0, len(tilt_angles), together)):
        projector = SliceProjector(tilt_angles=tilt_angles[tilts], depth=depth, width=width)
        for first in range(0, height, rows):
            slab = torch.from_numpy(np.array(volume[:, first : first + rows], dtype=np.float32))
            images[tilts, first : first + rows] = projector(slab).numpy()
    return images if mode == "linear" else np.exp(-images, out=images)


def _check_lattices(volume: Volume, reference: Volume) -> None:
    first, second = volume.attenuation, reference.attenuation
    for name, array in (("volume", first), ("reference", second)):
        if array.ndim != 3:
            raise ValueError(f"the {name} has shape {array.shape}; give a volume (z, y, x)")
    if first.shape != second.shape:
        sizes = [" x ".join(map(str, array.shape)) for array in (first, second)]
        other = better_orientation(first, second)
        advice = "crop or resample one to the grid of the other" if other is None else other.in_words()
        raise ValueError(f"the volume is {sizes[0]} voxels and the reference {sizes[1]}; {advice}")
    if (
        volume.voxel_size
        and reference.voxel_size
        and abs(volume.voxel_size / reference.voxel_size - 1) > HARMLESS["pixel size"]
    ):
        raise ValueError(
            f"voxels of {volume.voxel_size:g} Å in the volume and {reference.voxel_size:g} Å in the reference differ; "
            "resample one of them, or correct its header"
        )


def comparison_report(volume: Array, reference: Array, comparison: Comparison, *, names: tuple[str, str]) -> Report:
    """A page with slices of both volumes and their difference, the Fourier shell correlation and a table of errors.

    Args:
        volume, reference: (z, y, x).
    """
    report = Report(f"{names[0]} compared with {names[1]}")
    line = matching_line(volume, reference, "affine")
    some, known = strided(volume), strided(reference)
    limits = grey_range(known)
    span = grey_range(np.abs(line(some) - known))[1]
    figure, axes = new_figure(3, 3)
    for row, (axis, letter) in zip(axes, enumerate("zyx"), strict=True):
        middle = [size // 2 for size in reference.shape][axis]
        true, found = (np.take(array, middle, axis=axis) for array in (reference, volume))
        show_image(row[0], true, f"reference, {letter} = {middle}", limits=limits)
        show_image(row[1], line(found), "volume, affinely matched", limits=limits)
        show_image(row[2], line(found) - true, "difference", limits=(-span, span))

    def errors() -> None:
        report.table(*error_table(comparison), caption="MSE per squared range of the reference; projections each.")
        report.heading("Resolution")
        reached = [reach_in_words(crossing, level, None) for level, crossing in comparison.crossings.items()]
        report.charts([_correlation_chart(comparison)], caption=f"It {'; it '.join(reached)}.")

    def slices() -> None:
        report.heading("Slices")
        report.figure(figure, caption="Three orthogonal slices through the centre.")

    report.columns(errors, slices)
    return report


def error_table(comparison: Comparison) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows of the errors."""
    header = ("compared", "MSE", "PSNR (dB)", "DSSIM")
    parts = {"volume": comparison.volume, "projections": comparison.projections}
    rows: list[tuple[str, ...]] = [
        (f"{part}, {scaling}", f"{errors.mse:.3e}", f"{errors.psnr:.2f}", f"{errors.dssim:.4f}")
        for part, by_scaling in parts.items()
        for scaling, errors in by_scaling.items()
    ]
    return header, rows


def _correlation_chart(comparison: Comparison) -> Chart:
    chart, band = Chart("Fourier shell correlation", x="cycles per voxel", y="correlation"), comparison.expected
    if band is not None:
        chart.fill(band.frequency[1:], band.low[1:], band.high[1:], colour=COLOURS["data"], label="with the truth")
    chart.plot(comparison.frequency[1:], comparison.correlation[1:])
    for threshold in comparison.crossings:
        chart.line(y=threshold)
    chart.limits["y"] = min(0.0, float(comparison.correlation[1:].min())), 1.05
    return chart
