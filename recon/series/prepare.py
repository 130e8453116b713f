"""Preparation of a tilt series, or its channels, for reconstruction: checks, alignment, sorting and screening."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from noiseflow.checks import Guard
from noiseflow.described import described
from noiseflow.progress import Progress
from recon.series.alignment import Alignment
from recon.series.alignment_search import find_alignment
from recon.series.first_guess import check_contrast
from recon.series.masks import plausible
from recon.series.orientation import Orientation, stacked
from recon.series.registration import AxisRegistration, register
from recon.series.screening import Screening, require_specimen, screen
from recon.series.shrinkage import estimate_shrinkage
from recon.series.tilt_series import TiltSeries, as_if_in_radians
from recon.series.views import AROUND, HARMLESS, angles_in_words, in_order


@described()
@dataclass(frozen=True)
class Prepared:
    """A prepared tilt series, with the results of alignment and screening.

    Attributes:
        tilt_series: the aligned series, sorted by angle, without rejected tilts.
        screening: consistency of every tilt with the others, in the order of the given series.
        alignment: alignment of the raw images, in the order of the given series; None if they were not transformed.
        guard: checks that failed, with their reasons.
        second: the prepared series about a second tilt axis, which `tilt_series` then includes; None without one.
        registration: the position of the second axis; None without one.

    Example:
        >>> import numpy as np, recon
        >>> series, unit = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), np.arange(-90, 90, 5.0))
        >>> recon.prepare(series).tilt_series.num_tilts
        36
    """

    tilt_series: TiltSeries
    screening: Screening
    alignment: Alignment | None
    guard: Guard = field(default_factory=Guard)
    second: Prepared | None = None
    registration: AxisRegistration | None = None

    @property
    def choices(self) -> dict[str, float | str]:
        """Values for a table of results."""
        found = ({} if self.alignment is None else self.alignment.choices()) | self.screening.choices()
        if self.second is None or self.registration is None:
            return found
        second = {f"{name}, second axis": value for name, value in self.second.choices.items()}
        return found | second | {"second axis (°)": f"{self.registration.axis:.2f}"}

    def as_dict(self) -> dict[str, Any]:
        """All results per tilt, JSON-serialisable."""
        return {
            "screening": self.screening.as_dict(),
            "alignment": None if self.alignment is None else self.alignment.as_dict(),
            "second_axis": None
            if self.second is None or self.registration is None
            else self.second.as_dict() | {"registration": self.registration.as_dict()},
        }


def prepare(
    tilt_series: TiltSeries,
    *,
    tilt_axis: float | None = None,
    refine_alignment: bool = False,
    alignment: Alignment | None = None,
    second_axis: TiltSeries | None = None,
    keep_tilts: bool = False,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Prepared:
    """Prepare a tilt series for reconstruction: checks, alignment, screening, and estimation of beam drift.

    Doubtful results are reported as `UserWarning`. A check that fails is listed in `Prepared.guard`; it does not stop the run.

    Args:
        tilt_series: the series as read.
        tilt_axis: direction of the tilt axis in the images, degrees from y towards −x; None for y, or to search it.
        refine_alignment: find the axis and the shift of every image.
        alignment: the alignment of the same tilts, such as that of another channel, in place of a search.
        second_axis: a series of the same specimen about a second tilt axis, about 90° from the first. It is prepared in the
            same way, registered, and becomes a part of the prepared series; see `recon.series.registration.register`.
        keep_tilts: keep tilts that are inconsistent with the others, with a warning.
        progress: called at each step of the alignment.

    Raises:
        ValueError: the tilt axis is not a valid angle, there are too few tilts to align, images are moved out of view, at
            least half of the images are blank, the images are inconsistent with an axis along y and their file states another
            tilt axis, or `alignment` is of other tilts or comes with another option.

    Example:
        >>> import numpy as np, recon
        >>> series, _ = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), np.arange(60, -61, -5.0))
        >>> recon.prepare(series).tilt_series.tilt_angles[0].item()  # by rising angle
        -60.0
    """
    if tilt_axis is not None and not abs(tilt_axis) <= 360:  # more than a full turn is a mistake
        raise ValueError(f"--tilt-axis {tilt_axis} must be a number of degrees, within ±360")
    if second_axis is not None:
        if alignment is not None:
            raise ValueError("--alignment is of one series; give --second-axis aligned stacks, or --refine-alignment")
        same = {"tilt_axis": tilt_axis, "refine_alignment": refine_alignment, "keep_tilts": keep_tilts}
        return _about_two_axes(tilt_series, second_axis, device=device, progress=progress, **same)
    guard, tilt_series = Guard(), plausible(tilt_series)
    _warn_of_angles(tilt_series.tilt_angles)
    guard("outliers", lambda: _warn_of_outliers(tilt_series), otherwise=None)
    if alignment is not None:
        if refine_alignment or tilt_axis is not None:
            raise ValueError("--alignment gives axis and shifts; remove --refine-alignment and --tilt-axis")
        alignment = alignment.joined(tilt_series)
    elif refine_alignment:
        alignment = find_alignment(tilt_series, tilt_axis=tilt_axis, device=device, progress=progress)
    elif tilt_axis is not None:
        alignment = Alignment.unshifted(tilt_series, tilt_axis)
    raw = tilt_series
    if alignment is not None:
        tilt_series = alignment.apply(raw)
    if tilt_series.num_tilts >= AROUND:  # which are enough to measure it
        shrinkage = guard("shrinkage", partial(estimate_shrinkage, tilt_series), otherwise=None)
        if shrinkage is not None and shrinkage.found and refine_alignment and alignment is not None:
            alignment = shrinkage.correct(alignment)
            tilt_series = alignment.apply(raw)
    require_specimen(tilt_series)
    # the standard orientation gives identical results for mirror images
    found = guard(
        "screening",
        lambda: screen(Orientation.of(tilt_series).series(tilt_series)),
        otherwise=Screening.of_all(tilt_series.num_tilts),
    )
    guard("contrast", lambda: check_contrast(found.passed(tilt_series)), otherwise=None)  # black frames invert it
    _require_axis(tilt_series, found)
    _warn_of_misfits(tilt_series, found, keep=keep_tilts)
    return Prepared(in_order(found.passed(tilt_series, keep=keep_tilts)), found, alignment, guard)


def _about_two_axes(first: TiltSeries, second: TiltSeries, **options: Any) -> Prepared:
    one, other = prepare(first, **options), prepare(second, **options)
    found = register(one.tilt_series, other.tilt_series, device=options["device"], progress=options["progress"])
    height, width = one.tilt_series.images.shape[1:]
    # the images of the second series are interpolated once, with the shifts of both steps
    moved = found.of_second(other.alignment or Alignment.unshifted(second)).apply(second, shape=(width, height))
    part = in_order(other.screening.passed(moved, keep=options["keep_tilts"]))
    turned = replace(one.tilt_series, tilt_angles=one.tilt_series.tilt_angles - found.first_offset)
    whole = stacked(turned, part, axis=found.stored_axis)
    return replace(one, tilt_series=whole, second=other, registration=found)


def _warn_of_angles(angles: NDArray[np.float64]) -> None:
    (values, counts), words = np.unique(np.round(angles, 6), return_counts=True), []
    if counts.max() > 1:
        repeated = angles_in_words(values[counts > 1])
        words.append(f"some tilt angles occur more than once ({repeated}); each image is used as a separate view")
    if as_if_in_radians(angles):
        words.append(f"the tilt angles span {np.ptp(angles):.2f}, as if in radians; give them in degrees")
    for text in words:
        warnings.warn(text, stacklevel=3)


def _warn_of_outliers(series: TiltSeries) -> None:
    step = max(1, series.images.size // 100_000)
    low, high = np.quantile(
        np.concatenate([part[::step].copy() for part in series.values()]).astype(np.float64), (0.02, 0.98)
    )
    far = [part[np.abs(part - (low + high) / 2) > 100 * (high - low)] for part in series.values()]
    found = np.abs(np.concatenate(far).astype(np.float64))
    if high > low and found.size:
        warnings.warn(
            f"{found.size} pixels deviate a hundred times more than the others (up to {found.max():.3g}) and would "
            "corrupt the volume; exclude them with --mask FILE, or replace them",
            stacklevel=3,
        )


def _require_axis(series: TiltSeries, found: Screening) -> None:
    """Handle a series that was not transformed and whose file states another axis than y: warn if the images are consistent with
    y, because aligned series may keep the entry; otherwise raise ValueError."""
    stated = series.tilt_axis
    if stated is None or abs((stated + 90) % 180 - 90) <= HARMLESS["axis along y"]:
        return
    words = (
        f"the file states a tilt axis of {stated:g}°, but the images are assumed to be aligned, with the axis along y"
    )
    advice = f"give --refine-alignment to start from it, --tilt-axis {stated:g} if only the direction is wrong, or --tilt-axis 0"
    if found.suspect.any():
        # not how many: of an unaligned needle, 13 or 18 of 77, by the rounding of the processor
        raise ValueError(f"{words}, and many tilts do not fit the volume of the others; {advice} if they are aligned")
    warnings.warn(f"{words}; if they are not, {advice} to silence this", stacklevel=3)


def _warn_of_misfits(series: TiltSeries, found: Screening, *, keep: bool) -> None:
    if found.suspect.any():
        warnings.warn(
            f"{found.suspect.sum()} of {series.num_tilts} tilts do not fit the volume of the others, too many to exclude: "
            "the alignment, the tilt axis or the tilt angles are probably wrong; give --refine-alignment, --tilt-axis or the "
            "correct --angles",
            stacklevel=3,
        )
    if not found.bad.any():
        return
    angles = series.tilt_angles[found.bad]
    what = f"{len(angles)} of {series.num_tilts} tilts do not fit the volume of the others: {angles_in_words(angles)}"
    advice = "kept (--keep-tilts)" if keep else "excluded (--keep-tilts keeps them)"
    warnings.warn(f"{what}; {advice}", stacklevel=3)


def prepare_channels(
    channels: Mapping[str, TiltSeries], *, align_on: TiltSeries | None = None, **options: Any
) -> dict[str, Prepared]:
    """Prepare channels of the same tilts by the alignment, screening and beam of one of them, or of their sum.

    A map with few counts determines neither an alignment nor which of its tilts are wrong. Channels are joined by tilt angle, and
    shifts are scaled if their images are binned.

    Args:
        channels: raw series by name, in their own detector units.
        align_on: the raw series that determines the alignment; the sum of all channels if None.
        **options: of `recon.prepare`, for that series.

    Raises:
        ValueError: as `recon.prepare`; or a channel shows other tilts, or the channels cannot be summed.

    Example:
        >>> import numpy as np, recon
        >>> haadf, _ = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), np.arange(-60, 61, 10.0))
        >>> maps = {"iron": haadf, "oxygen": haadf}
        >>> {name: each.tilt_series.num_tilts for name, each in recon.prepare_channels(maps, align_on=haadf).items()}
        {'iron': 13, 'oxygen': 13}
    """
    reference = _summed(channels) if align_on is None else align_on
    found = prepare(reference, **options)
    known = found.alignment or Alignment.unshifted(reference)  # where nothing was aligned, this still joins the tilts
    prepared = {}
    for name, series in channels.items():
        try:
            order, alignment = known.order_of(series), known.joined(series)
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error
        aligned = series if found.alignment is None else alignment.apply(series)
        screening = found.screening.of(order)
        passed = in_order(screening.passed(aligned, keep=options.get("keep_tilts", False)))
        prepared[name] = Prepared(
            passed, screening, None if found.alignment is None else alignment, replace(found.guard)
        )
    return prepared


def _summed(channels: Mapping[str, TiltSeries]) -> TiltSeries:
    """The sum of all channels, with the tilts of the first. Raises ValueError if there are no channels, or their sizes, tilts
    or modes differ."""
    (name, first), *others = channels.items()
    images, mask = np.array(first.images, dtype=np.float32), first.used
    for other, series in others:
        if series.images.shape != images.shape or not np.allclose(series.tilt_angles, first.tilt_angles):
            raise ValueError(
                f"channels {name} and {other} differ in size or tilts and cannot be summed; name the one to align with "
                "--align-on FILE"
            )
        images += series.images
        mask = mask & series.used
    return replace(first, images=images, mask=None if mask.all() else mask)
