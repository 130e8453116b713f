"""Check whether the contrast of a tilt series matches its mode."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch

from noiseflow.arrays import strided
from noiseflow.io import mapped
from recon.projection.classical import sirt
from recon.projection.image_formation import Transmission
from recon.projection.projector import SliceProjector
from recon.series.first_guess import estimate_response
from recon.series.masks import coarse, used_values
from recon.series.matching import ITERATIONS
from recon.series.tilt_series import Mode, TiltSeries
from recon.series.views import HARMLESS


def invert_contrast(tilt_series: TiltSeries) -> TiltSeries:
    """Invert the contrast: every pixel value becomes largest + smallest − value of those used, in the same data type."""
    images, mask = tilt_series.images, tilt_series.mask
    whole = images if mask is None else images[mask]
    largest, smallest = whole.max(), whole.min()
    # this order avoids integer overflow
    swapped = ((largest - image) + smallest for image in images)
    return replace(tilt_series, images=mapped.mapped_copy(swapped, images.shape, images.dtype))


def check_contrast(tilt_series: TiltSeries) -> None:
    """Warn if a coarse non-negative volume explains the images better with inverted contrast, or if parts of bright-field
    images are much brighter than vacuum."""
    as_given, swapped = explained_both(tilt_series)
    if swapped > as_given + HARMLESS["contrast"]:
        given, other = ("bright field", "--mode linear if these are HAADF or EDX images")
        if tilt_series.mode == "linear":
            given, other = ("HAADF or EDX", "--mode transmission if these are bright-field images")
        warnings.warn(
            f"the contrast looks inverted for {given}: a coarse volume explains {max(as_given, 0):.0%} of the images, and "
            f"{swapped:.0%} with inverted contrast; give {other}, otherwise --invert-contrast",
            stacklevel=2,
        )
    elif tilt_series.mode == "transmission":
        _check_intensity(coarse(tilt_series))


def likely_mode(tilt_series: TiltSeries) -> Mode | None:
    """``linear`` if a coarse non-negative volume on a dark background explains the images better than their inverse,
    ``transmission`` if it is the other way round; if they are explained alike, the median of the values decides, or nothing
    (None).

    Both shares are those of the linear model, whose volume follows noise alike in both. Counts that are zero in most pixels have
    a dark background.
    """
    images, used = strided(tilt_series.images), strided(tilt_series.used)
    values = images[used]
    if (values == values.min()).mean() > 0.5:
        return "linear"
    dark, bright = explained_both(replace(tilt_series, mode="linear"))
    if abs(dark - bright) > HARMLESS["contrast"]:
        return "linear" if dark > bright else "transmission"
    low, usual, high = np.quantile(values, (0.005, 0.5, 0.995))
    place = (usual - low) / max(high - low, 1e-30)
    return (
        "linear" if place < HARMLESS["background"] else "transmission" if place > 1 - HARMLESS["background"] else None
    )


def explained_both(tilt_series: TiltSeries) -> tuple[float, float]:
    """Shares of the variance that coarse volumes explain, as given and with inverted contrast."""
    series = coarse(tilt_series)
    return explained(series), explained(invert_contrast(series))


def explained(tilt_series: TiltSeries) -> float:
    """Share of the variance of the images that a non-negative volume explains after a few iterations of SIRT."""
    images = torch.from_numpy(np.asarray(tilt_series.images, dtype=np.float32))
    used = torch.from_numpy(tilt_series.used).float()
    try:
        response = estimate_response(tilt_series)
    except ValueError:  # no positive incident intensity, so there is no such volume
        return 0.0
    width = images.shape[2]
    projector = SliceProjector(tilt_angles=tilt_series.tilt_angles, depth=width, width=width)
    with torch.no_grad():
        volume = sirt(response.invert(images).contiguous(), projector, num_iterations=3 * ITERATIONS, used=used)
        predicted = response(projector(volume).transpose(1, 2)).transpose(1, 2)
    mean = (images * used).sum() / used.sum()
    return 1 - float(((predicted - images).square() * used).sum() / ((images - mean).square() * used).sum())


def _check_intensity(tilt_series: TiltSeries) -> None:
    response = estimate_response(tilt_series)
    if not isinstance(response, Transmission):
        return
    intensity = float(response.intensity.max())
    brightest = float(np.quantile(used_values(tilt_series), 0.999))
    if brightest > HARMLESS["brightest"] * intensity:
        warnings.warn(
            f"parts of the images reach {brightest:.4g}, but the incident intensity is about {intensity:.4g}; bright-field "
            "images cannot be brighter than vacuum: give --mode linear for HAADF or EDX images, or mask those parts",
            stacklevel=3,
        )
