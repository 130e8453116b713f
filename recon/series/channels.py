"""Several channels of one tilt series, such as HAADF images and element maps, with one alignment and one screening."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from recon.series.alignment import Alignment
from recon.series.prepare import Prepared, prepare
from recon.series.tilt_series import TiltSeries
from recon.series.views import in_order


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
        >>> density = np.zeros((16, 16, 16))
        >>> density[6:10, 6:10, 6:10] = 1.0
        >>> haadf, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 10.0))
        >>> maps = {"iron": haadf, "oxygen": haadf}
        >>> {name: each.tilt_series.num_tilts for name, each in recon.prepare_channels(maps, align_on=haadf).items()}
        {'iron': 13, 'oxygen': 13}
    """
    reference = summed(channels) if align_on is None else align_on
    found = prepare(reference, **options)
    height, width = reference.images.shape[1:]
    # where nothing was aligned, this still joins the tilts
    known = Alignment(
        0.0,
        np.zeros((reference.num_tilts, 2)),
        reference.tilt_angles,
        image_shape=(height, width),
        pixel_size=reference.pixel_size,
    )
    known = found.alignment or known
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


def summed(channels: Mapping[str, TiltSeries]) -> TiltSeries:
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
