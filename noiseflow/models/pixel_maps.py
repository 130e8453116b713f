"""Detectors with per-pixel gains, offsets and read noises."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.arrays import Given, alike, floating
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import PickedSignal, Signal, given_to, require_image, values_of
from noiseflow.models.wrapper import ModelAround, of_inner


class WithMaps(ModelAround):
    """A noise model of a detector whose pixels have individual gains, offsets and, optionally, read noises.

    The observation is gain·o + offset, with o drawn from the inner model at the clean signal. Signals are those of an ideal pixel
    (gain 1, offset 0), as after a flat-field correction; observations are raw. The maps are known and not fitted.

    Args:
        model: the noise model of an ideal pixel.
        gain: (y, x) relative gains, positive; 1 by default.
        offset: (y, x) offsets, detector units; 0 by default.
        variance: (y, x) or a number, variance of raw dark observations before rounding, detector units². It replaces the read
            noise of the inner model, which must be a `PoissonGaussian`, possibly `Digitised`. By default the model's own.
        shape: (y, x) size of the maps, if no map is given.

    Raises:
        ValueError: there is no map, maps differ in size or are not finite, or gains or variances are not positive.

    Example:
        >>> import noiseflow, torch
        >>> gain = torch.tensor([[1.0, 2.0]])
        >>> camera = noiseflow.WithMaps(noiseflow.Gaussian(0.1), gain=gain)
        >>> camera(torch.full((1, 2), 3.0)).mean
        tensor([[3., 6.]])
    """

    needs_image = True
    without_converter = of_inner("without_converter")
    gain: Tensor
    offset: Tensor
    variance: Tensor | None

    def __init__(
        self,
        model: nn.Module,
        gain: Tensor | NDArray[Any] | None = None,
        offset: Tensor | NDArray[Any] | None = None,
        variance: Tensor | NDArray[Any] | float | None = None,
        *,
        shape: Sequence[int] | None = None,
    ) -> None:
        super().__init__(model)
        if variance is not None and np.ndim(variance) == 0:
            check(variance=variance)
            variance = float(variance)
        given = [each for each in (gain, offset, variance) if each is not None and not isinstance(each, (int, float))]
        sizes = [tuple(each.shape) for each in given] or [tuple(shape or ())]
        if len(sizes[0]) != 2 or len(set(sizes)) != 1:
            raise ValueError(f"the maps have sizes {sizes}; give a gain or an offset map (y, x), or maps of equal size")
        self.register_buffer("gain", torch.ones(sizes[0]) if gain is None else floating(gain).detach().clone())
        self.register_buffer("offset", torch.zeros(sizes[0]) if offset is None else floating(offset).detach().clone())
        alike = isinstance(variance, (int, float))  # also when a file is loaded, whose maps are filled in later
        known = None if variance is None or alike else floating(variance).detach().clone()
        self.register_buffer("variance", torch.full(sizes[0], variance) if isinstance(variance, float) else known)
        checked = ([] if gain is None else [self.gain.log()]) + ([] if offset is None else [self.offset])
        checked += [] if self.variance is None or alike else [self.variance.log()]
        if not all(bool(torch.isfinite(each).all()) for each in checked):
            raise ValueError("gains or variances are not positive, or values are NaN; correct the maps at these pixels")

    def forward(self, signal: Signal) -> NoiseDistribution:
        """The distribution of raw pixel values.

        Raises:
            ValueError: the signal is flat, images and maps differ in size, or there is a variance map and the inner model has
                no read noise.
        """
        gain, offset = self._at(signal)
        inner = given_to(self.model, signal)
        if self.variance is None:
            base: NoiseDistribution = self.model(inner)
        else:
            base = self.model.at_read_noise(inner, self._of_pixels(self.variance, signal).sqrt() / gain)
        return base.rescaled(gain, offset)

    @staticmethod
    def _of_pixels(values: Tensor, signal: Signal) -> Tensor:
        """Values of a map at the pixels of a signal."""
        found = values.reshape(-1)[signal.place] if isinstance(signal, PickedSignal) else values
        kind = values_of(signal).dtype
        wide = torch.promote_types(kind, torch.float32) if kind.is_floating_point else torch.get_default_dtype()
        return found.to(wide)

    def _at(self, signal: Signal) -> tuple[Tensor, Tensor]:
        """Gain and offset at the pixels of a signal."""
        require_image(signal, "every pixel has its own gain and offset")
        if isinstance(signal, Tensor) and signal.shape[-2:] != self.gain.shape:
            raise ValueError(f"images are {tuple(signal.shape[-2:])} pixels, maps {tuple(self.gain.shape)}; crop them")
        return self._of_pixels(self.gain, signal), self._of_pixels(self.offset, signal)

    def standardise(self, signal: PickedSignal, observation: Tensor) -> None:
        """Standardise the inner model on pixel values corrected by the maps."""
        gain, offset = self._at(signal)
        self.model.standardise(given_to(self.model, signal), (observation - offset) / gain)

    def correct(self, images: Given) -> Given:
        """Raw images (..., y, x) as ideal pixels would read them; `without_converter` is their noise model. Raises ValueError if
        images and maps differ in size."""
        raw = floating(images)
        gain, offset = self._at(raw)
        return alike((raw - offset) / gain, images)

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model, without the inner model and the maps."""
        return {"shape": list(self.gain.shape)} | ({} if self.variance is None else {"variance": 1.0})

    def extra_repr(self) -> str:
        return f"maps of {self.gain.shape[0]} x {self.gain.shape[1]} pixels"
