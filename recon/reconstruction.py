"""What every method of reconstruction gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from noiseflow.described import described
from recon.series.orientation import Orientation
from recon.series.tilt_series import Volume

if TYPE_CHECKING:
    from torch import nn

    from noiseflow import FitResult
    from recon.joint.signal_model import TomographySignal
    from recon.joint.weight import WeightChoice
    from recon.uncertainty.result import Uncertainty


@described(projections="detector units")
@dataclass(frozen=True)
class Reconstruction:
    """A volume, and what was learnt with it.

    Attributes:
        volume: the clean volume.
        projections: (tilt, y, u) the clean images that the volume predicts, detector units.
        method: the method that made it.
        noise_model: the noise model it was fitted with; None where the method has none.
        fit_result: held-out likelihood and its history; None where nothing was fitted.
        signal_model: field, projector and image formation, as fitted, in `orientation`; None where the method has none.
        weight_choice: the weights tried and their held-out likelihoods, where the weight was chosen.
        choices: what was chosen or estimated, by name, for a table.
        likelihood: the noise model under which the volume was fitted, where `noise_model` only describes what the fit left.
        uncertainty: error bars of the volume, where they were asked for.
        slices_at_once: slices of a block, at most; None where the volume was reconstructed whole.
        orientation: flips of the series before the fit; all other attributes are of the series as it was given.

    Example:
        >>> import numpy as np, recon
        >>> density = np.zeros((16, 16, 16))
        >>> density[6:10, 6:10, 6:10] = 1.0
        >>> series, unit = recon.clean_tilt_series(density, np.arange(-90, 90, 5.0))
        >>> result = recon.reconstruct(series, recon.VolumeGrid.of(series, 16), method="sirt", num_steps=30)
        >>> result.method, result.projections.shape, result.noise_model is None
        ('sirt', (36, 16, 16), True)
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

    def turned(self, orientation: Orientation) -> Reconstruction:
        """The same for the series flipped back, whose tilts stand in reverse where their angles were negated."""
        if orientation == Orientation():
            return self
        bars = self.uncertainty
        if bars is not None:
            bars = replace(bars, std=_turned(bars.std, orientation), bias=_turned(bars.bias, orientation))
        return replace(
            self,
            volume=_turned(self.volume, orientation),
            projections=orientation.projections(self.projections),
            uncertainty=bars,
            orientation=orientation,
        )

    @property
    def weight(self) -> float:
        """Weight of the regulariser; NaN where there is none."""
        return math.nan if self.signal_model is None else float(self.signal_model.weight)

    @property
    def caution(self) -> str | None:
        """What readers of the error bars must know, where the series is quiet."""
        if self.uncertainty is None or self.likelihood is None:
            return None
        return (
            "error bars of a quiet series cannot be relied on: the fit was least squares with one width for all pixels, "
            "which is too wide where the sample is dark, and no error bar covers misalignment"
        )

    @property
    def weights_tried(self) -> dict[float, float]:
        """Weight of the regulariser → held-out negative log-likelihood, nats per pixel; empty where it was not chosen."""
        return {} if self.weight_choice is None else self.weight_choice.tried

    @property
    def response(self) -> dict[str, list[float]]:
        """Intensity and offset of every tilt, see `recon.projection.image_formation`; empty where nothing was fitted."""
        found = {} if self.signal_model is None else self.signal_model.response()
        return {name: values[::-1] for name, values in found.items()} if self.orientation.negated else found


def _turned(volume: Volume, orientation: Orientation) -> Volume:
    return replace(volume, attenuation=orientation.volume(volume.attenuation))
