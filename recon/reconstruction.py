"""The result of a reconstruction."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from torch import nn

from noiseflow import FitResult
from noiseflow.described import described
from noiseflow.fitting.steps import WeightChoice
from recon.fields.fields import Field, sampled_volume
from recon.joint.signal_model import TomographySignal
from recon.series.orientation import Orientation
from recon.series.tilt_series import Volume
from recon.uncertainty.result import Uncertainty


@described(projections="detector units")
@dataclass(frozen=True)
class Reconstruction:
    """The result of a reconstruction.

    Attributes:
        projections: (tilt, y, u) noise-free images predicted by the volume, detector units.
        noise_model: the noise model; None if the method has none.
        fit_result: held-out likelihood and its history; None if nothing was fitted.
        signal_model: fitted field, projector and image formation, in `orientation`; None if the method has none.
        weight_choice: the tried weights and their held-out likelihoods, if the weight was chosen automatically.
        choices: chosen and estimated values by name, for a table.
        likelihood: the noise model of the fit, if `noise_model` was fitted only to the residuals.
        uncertainty: error bars of the volume, if requested.
        slices_at_once: largest number of slices of a block; None if the volume was reconstructed whole.
        orientation: flips of the series before the fit; all other attributes refer to the given series.
        tilts: (tilts,) place of every tilt of the given series among those of the fit, where copies are one; None if alike.

    Example:
        >>> import numpy as np, recon
        >>> series, _ = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), np.arange(-90, 90, 5.0))
        >>> recon.reconstruct(series, method="sirt", num_steps=30).projections.shape
        (36, 16, 16)
    """

    volume: Volume
    projections: NDArray[np.float32]
    method: str
    noise_model: nn.Module | None = None
    fit_result: FitResult | None = None
    signal_model: TomographySignal | None = None
    weight_choice: WeightChoice | None = None
    choices: dict[str, float | str] = field(default_factory=dict)
    likelihood: nn.Module | None = None
    uncertainty: Uncertainty | None = None
    slices_at_once: int | None = None
    orientation: Orientation = field(default_factory=Orientation)
    tilts: NDArray[np.int64] | None = None

    def turned(self, orientation: Orientation) -> Reconstruction:
        """The result for the series with the orientation reverted; tilts are reversed if their angles were negated."""
        if orientation == Orientation():
            return self
        if self.signal_model is not None:
            self.signal_model.field.flipped = orientation.axes
        bars = self.uncertainty and self.uncertainty.mapped(lambda part: _turned(part, orientation))
        return replace(
            self,
            volume=_turned(self.volume, orientation),
            projections=orientation.projections(self.projections),
            uncertainty=bars,
            orientation=orientation,
        )

    def levelled(self, x_tilt: float) -> Reconstruction:
        """The result with a level volume and level error bars, see `recon.Volume.levelled`; projections do not change."""
        if not x_tilt:
            return self
        bars = self.uncertainty and self.uncertainty.mapped(lambda part: part.levelled(x_tilt))
        choices = self.choices | {"levelled about x (°)": f"{x_tilt:.3g}"}
        return replace(self, volume=self.volume.levelled(x_tilt), uncertainty=bars, choices=choices)

    @property
    def field(self) -> Field | None:
        """The volume as a field, which has values at any point; None for methods without one, and for volumes in blocks."""
        return None if self.signal_model is None or self.slices_at_once is not None else self.signal_model.field

    def sampled(self, voxel_size: float) -> Volume:
        """The volume with other voxels, from the field.

        Args:
            voxel_size: Å; smaller voxels show the field between the voxels of the fit.

        Raises:
            ValueError: there is no field, or its voxel size is not known.
        """
        if self.field is None:
            how = f"method {self.method}" if self.slices_at_once is None else "a volume in blocks"
            raise ValueError(f"{how} has no field to sample; fit the whole volume with --method joint")
        return sampled_volume(self.field, voxel_size)

    @property
    def weight(self) -> float:
        """Weight of the regulariser; NaN if there is none."""
        return math.nan if self.signal_model is None else float(self.signal_model.weight)

    @property
    def caution(self) -> str | None:
        """A warning about the error bars if the noise of the series is small, otherwise None."""
        if self.uncertainty is None or self.likelihood is None:
            return None
        return (
            "error bars are not reliable for series with little noise: the fit was least squares with one width for all "
            "pixels, which is too wide where the sample is dark, and error bars do not include misalignment"
        )

    @property
    def weights_tried(self) -> dict[float, float]:
        """Tried weights → held-out negative log-likelihood, nats per pixel; empty if the weight was not chosen."""
        return {} if self.weight_choice is None else self.weight_choice.tried

    @property
    def response(self) -> dict[str, list[float]]:
        """Intensity and offset of every tilt, see `recon.projection.image_formation`; empty if nothing was fitted."""
        found = {} if self.signal_model is None else self.signal_model.response()
        at = ... if self.tilts is None else self.tilts
        return {name: np.array(values)[at].tolist() for name, values in found.items()}


def _turned(volume: Volume, orientation: Orientation) -> Volume:
    return replace(volume, attenuation=orientation.volume(volume.attenuation))
