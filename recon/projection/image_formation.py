"""Image formation: conversion of line integrals to noise-free pixel values."""

import math

import torch
from torch import Tensor, nn

from noiseflow.models.base import Described

_FAINTEST = 1e-3  # share of the beam, or of what a bent response can show, below which line integrals are clipped


class _Response(Described):
    """A response of a detector that may bend line integrals, then blurs images.

    Attributes:
        blur: standard deviation of a Gaussian, pixels; 0 at first.
        bend: logarithm of the slope at a line integral of zero relative to that at `reach`; 0 at first. A line integral then
            counts as reach·(1 − exp(−bend·line/reach)) / (1 − exp(−bend)), which leaves zero and `reach` as they are.
        reach: line integral of the brightest matter.
    """

    blur: Tensor
    bend: Tensor
    reach: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name, value in (("blur", 0.0), ("bend", 0.0), ("reach", 1.0)):
            self.register_buffer(name, torch.tensor(value))

    def _bent(self, lines: Tensor) -> Tensor:
        if not bool(self.bend):
            return lines
        return torch.expm1(-self.bend / self.reach * lines) * (self.reach / torch.expm1(-self.bend))

    def _straight(self, lines: Tensor) -> Tensor:
        """Inverse of `_bent`; line integrals that no matter reaches are clipped."""
        if not bool(self.bend):
            return lines
        rest = 1 + lines / self.reach * torch.expm1(-self.bend)
        return torch.log(rest.clamp_min(_FAINTEST)) * (-self.reach / self.bend)

    def _blurred(self, signal: Tensor) -> Tensor:
        """The signal (tilt, u, y) as the detector records it."""
        if not bool(self.blur):
            return signal
        for axis in (-1, -2):
            place = torch.arange(signal.shape[axis], device=signal.device)
            weights = torch.exp(-0.5 * ((place[:, None] - place) / self.blur) ** 2).to(signal)
            signal = (signal.transpose(axis, -1) @ (weights / weights.sum(1, keepdim=True)).T).transpose(axis, -1)
        return signal


class Transmission(_Response):
    """Bright field: signal = I0·exp(−line integral) + offset, with one incident intensity I0 for each tilt or for all tilts.

    A fit changes all intensities by a common factor, because the images determine their ratios better than a haze of the volume
    lets the fit: a film of 100 counts, whose beam changed by 3 %, had 1.16 times its mass. `match` finds the ratios.

    Args:
        intensity: incident intensity, detector units; a number, or one per tilt.
        offset: detector units; kept fixed.
        estimate: whether to fit the intensity.

    Raises:
        ValueError: an intensity is not positive.

    Example:
        >>> import recon, torch
        >>> recon.Transmission(intensity=100.0)(torch.tensor([[[0.0, 1.0]]])).round().tolist()  # (tilt, u, y)
        [[[100.0, 37.0]]]
    """

    offset: Tensor

    def __init__(self, intensity: float | Tensor = 1.0, *, offset: float = 0.0, estimate: bool = True) -> None:
        super().__init__()
        start = torch.as_tensor(intensity, dtype=torch.get_default_dtype()).reshape(-1, 1, 1)
        if not bool((start > 0).all()):
            raise ValueError("the intensity must be positive; is the contrast inverted, or the offset too high?")
        self.log_intensity = nn.Parameter(start.log(), requires_grad=estimate)
        self.register_buffer("offset", torch.tensor(float(offset)))

    def forward(self, line_integrals: Tensor) -> Tensor:
        """Convert line integrals (tilt, u, y) to signals of the same shape."""
        common = self.log_intensity.mean()
        beams = common + (self.log_intensity - common).detach()
        return self._blurred(torch.exp(beams - self._bent(line_integrals)) + self.offset)

    @property
    def vacuum(self) -> nn.Parameter:
        """The parameter that gives the signal without an object."""
        return self.log_intensity

    @property
    def vacuum_ratios(self) -> Tensor:
        """Signal without an object relative to its geometric mean over the tilts, (1, 1, 1) or (tilts, 1, 1), without offset."""
        return _relative(self.log_intensity.detach())

    @torch.no_grad()
    def set_vacuum(self, level: float) -> None:
        """Set the signal without an object, detector units; of several tilts its geometric mean, without offset."""
        self.log_intensity.add_((level - self.offset).clamp_min(1e-30).log() - self.log_intensity.mean())

    def invert(self, signal: Tensor) -> Tensor:
        """Line integrals of signals; values below a thousandth of the incident intensity are clipped to it."""
        share = (signal - self.offset) / self.log_intensity.detach().exp()
        return self._straight(-torch.log(share.clamp_min(_FAINTEST)))

    @torch.no_grad()
    def match(self, line_integrals: Tensor, images: Tensor, use: Tensor) -> None:
        """Fit the intensity (common or per tilt) to images (tilt, u, y) by least squares at the pixels `use`."""
        share = torch.exp(-self._bent(line_integrals)) * use
        dims = (0, 1, 2) if self.log_intensity.numel() == 1 else (1, 2)
        intensity = ((images - self.offset) * share).sum(dims, keepdim=True) / (share**2).sum(dims, keepdim=True)
        self.log_intensity.copy_(torch.where(intensity > 0, intensity.log(), self.log_intensity))

    def extra_repr(self) -> str:
        learnt = ", learnt" if self.log_intensity.requires_grad else ""
        return f"intensity={_range(self.intensity)}{learnt}, offset={float(self.offset):.4g}"

    @property
    def intensity(self) -> Tensor:
        """Incident intensity, (1,) or (tilts,)."""
        return self.log_intensity.detach().exp().reshape(-1)

    def per_tilt(self, num_tilts: int) -> dict[str, list[float]]:
        """Incident intensity and offset of every tilt, detector units."""
        return {"intensity": _each(self.intensity, num_tilts), "offset": _each(self.offset, num_tilts)}


class Linear(_Response):
    """HAADF or EDX: signal = gain·beam·line integral + offset.

    The gain is a unit, not a parameter: it sets the scale of the volume. The offset (detector pedestal, thin support) is fitted
    for each tilt or for all tilts, as are changes of the beam between tilts, if given.

    Args:
        gain: detector units per unit of line integral.
        offset: detector units; a number, or one per tilt.
        beam: (tilts,) incident intensities, of which only the ratios matter; None if they are equal.
        offset_unit: unit of the offset parameter, a line integral of typical size in the data.
        estimate: whether to fit offset and beam.

    Attributes:
        least_offset: lower bound of the offset, detector units; −∞ at first.

    Raises:
        ValueError: gain or offset unit is zero or not finite.

    Example:
        >>> import recon, torch
        >>> recon.Linear(gain=10.0, offset=3.0)(torch.tensor([[[0.0, 0.5]]])).tolist()  # (tilt, u, y)
        [[[3.0, 8.0]]]
    """

    gain: Tensor
    offset_unit: Tensor
    least_offset: Tensor
    log_beam: nn.Parameter | None

    def __init__(
        self,
        gain: float = 1.0,
        *,
        offset: float | Tensor = 0.0,
        beam: Tensor | None = None,
        offset_unit: float = 1.0,
        estimate: bool = True,
    ) -> None:
        super().__init__()
        for name, unit in (("gain", gain), ("offset_unit", offset_unit)):
            if not math.isfinite(unit) or unit == 0:
                raise ValueError(f"{name.replace('_', ' ')} {unit} must be finite and not zero")
            self.register_buffer(name, torch.tensor(float(unit)))
        self.register_buffer("least_offset", torch.tensor(-math.inf))
        start = torch.as_tensor(offset, dtype=torch.get_default_dtype()).reshape(-1, 1, 1)
        self.scaled_offset = nn.Parameter(start / (gain * offset_unit), requires_grad=estimate)
        log_beam = None if beam is None else nn.Parameter(beam.reshape(-1, 1, 1).log(), requires_grad=estimate)
        self.register_parameter("log_beam", log_beam)

    def forward(self, line_integrals: Tensor) -> Tensor:
        """Convert line integrals (tilt, u, y) to signals of the same shape."""
        with torch.no_grad():
            least = self.least_offset / (self.gain * self.offset_unit)
            if bool((self.scaled_offset < least).any()):
                self.scaled_offset.clamp_(min=least)
        lines = self._bent(line_integrals)
        if self.log_beam is not None:
            lines = lines * _relative(self.log_beam)
        return self._blurred(self.gain * (lines + self.offset_unit * self.scaled_offset))

    @property
    def vacuum(self) -> nn.Parameter:
        """The parameter that gives the signal without an object."""
        return self.scaled_offset

    @property
    def vacuum_ratios(self) -> Tensor:
        """(1, 1, 1) one: without an object, no beam changes the signal."""
        return torch.ones_like(self.scaled_offset[:1])

    @torch.no_grad()
    def set_vacuum(self, level: float) -> None:
        """Set the signal without an object, detector units."""
        self.scaled_offset.copy_((level / (self.gain * self.offset_unit)).expand_as(self.scaled_offset))

    def invert(self, signal: Tensor) -> Tensor:
        """Line integrals of signals."""
        scaled = signal / self.gain - self.offset_unit * self.scaled_offset.detach()
        return self._straight(scaled if self.log_beam is None else scaled / _relative(self.log_beam.detach()))

    @torch.no_grad()
    def match(self, line_integrals: Tensor, images: Tensor, use: Tensor) -> None:
        """Fit a common offset to images (tilt, u, y) by least squares at the pixels `use`."""
        lines = self._bent(line_integrals)
        scaled = lines if self.log_beam is None else lines * _relative(self.log_beam)
        self.scaled_offset.fill_(float((images / self.gain - scaled)[use].mean() / self.offset_unit))

    def extra_repr(self) -> str:
        learnt = ", learnt" if self.scaled_offset.requires_grad else ""
        beam = "" if self.log_beam is None else f", beam={_range(_relative(self.log_beam.detach()))}"
        return f"gain={float(self.gain):.4g}, offset={_range(self.offset)}{learnt}{beam}"

    @property
    def offset(self) -> Tensor:
        """Offset, detector units, (1,) or (tilts,)."""
        return (self.gain * self.offset_unit * self.scaled_offset.detach()).reshape(-1)

    def per_tilt(self, num_tilts: int) -> dict[str, list[float]]:
        """Relative intensity (geometric mean 1) and offset (detector units) of every tilt."""
        beam = torch.ones(1) if self.log_beam is None else _relative(self.log_beam.detach()).reshape(-1)
        return {"relative intensity": _each(beam, num_tilts), "offset": _each(self.offset, num_tilts)}


def _each(values: Tensor, num_tilts: int) -> list[float]:
    return [float(value) for value in values.reshape(-1).expand(num_tilts)]


def _range(values: Tensor) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g}" if values.numel() == 1 else f"{low:.4g} … {high:.4g} ({values.numel()} tilts)"


def _relative(log_beam: Tensor) -> Tensor:
    """The beam with geometric mean 1, because a brighter beam cannot be distinguished from a denser volume."""
    return torch.exp(log_beam - log_beam.mean())
