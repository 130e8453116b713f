"""Noise models for other programs: a deepinv noise model, and the Gaussian-mixture file of PN2V and CAREamics."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.fitting.fit import fit
from noiseflow.io import atomic_path, check_output
from noiseflow.metrics.evaluation import kl_divergence
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.digitised import Digitised
from noiseflow.models.mixture import MixtureDistribution

_NUM_PIXELS = 100_000
_LEAST_VARIANCE = 1e-4  # of the noise's own


def to_deepinv(noise_model: nn.Module, *, seed: int = 0) -> Any:
    """A noise model as a ``deepinv.physics.NoiseModel``: a module called with ``(x, seed=None)`` that gives noisy ``x``.

    Args:
        noise_model: the model; it is not copied.
        seed: of the generator that is used where a call gives no seed.

    Returns:
        What ``deepinv.physics.Physics(noise_model=…)`` takes. Images are in the noise model's detector units, any shape.

    Raises:
        ModuleNotFoundError: deepinv is not installed.
    """
    generator = torch.Generator(next(noise_model.parameters()).device).manual_seed(seed)
    return _deepinv_class()(noise_model, generator)


@functools.cache
def _deepinv_class() -> Any:
    try:
        from deepinv.physics import NoiseModel as DeepinvNoiseModel
    except ImportError as error:
        raise ModuleNotFoundError("to_deepinv needs deepinv; python -m pip install 'noiseflow[deepinv]'") from error

    class FittedNoise(DeepinvNoiseModel):  # type: ignore[misc]
        """Noise of a fitted noiseflow model."""

        def __init__(self, model: nn.Module, generator: torch.Generator) -> None:
            super().__init__(noise_model=self._sample, rng=generator)
            self.model = model

        def _sample(self, signal: Tensor) -> Tensor:
            with torch.no_grad():
                noisy: Tensor = self.model(signal).sample(generator=self.rng)
            return noisy

    return FittedNoise


def to_pn2v_gmm(
    noise_model: nn.Module,
    path: str | Path,
    *,
    signal_range: tuple[float, float] | None = None,
    num_gaussians: int = 3,
    num_coefficients: int = 4,
    num_steps: int = 1000,
    seed: int = 0,
) -> float:
    """Write the Gaussian-mixture noise model of PN2V and CAREamics that comes closest to a noise model.

    A mixture whose means, variances and log-weights are polynomials of the signal is fitted to draws of the model. Its mean is
    the signal and it has no rounding or clipping: of a `Digitised` model, the model inside is written.

    Args:
        noise_model: the model.
        path: ``.npz`` file to write; ``GaussianMixtureNMConfig(path=…)`` of CAREamics reads it.
        signal_range: signals to cover, detector units; those the model was fitted on by default.
        num_gaussians: Gaussians of the mixture.
        num_coefficients: coefficients of each polynomial.
        num_steps: optimisation steps.
        seed: of all random choices.

    Returns:
        The divergence of the mixture from the model, nats per pixel, mean over the signals.

    Raises:
        ValueError: the model does not tell which signals it was fitted on and `signal_range` is not given, or the range is empty.
    """
    path = check_output(path, suffixes=frozenset({".npz"}))
    model = noise_model.model if isinstance(noise_model, Digitised) else noise_model
    low, high = _fitted_range(model) if signal_range is None else signal_range
    if not low < high:
        raise ValueError(f"signal_range is {low:g} … {high:g}; the first must lie below the second")
    generator = torch.Generator().manual_seed(seed)
    signal = low + (high - low) * torch.rand(_NUM_PIXELS, generator=generator)
    with torch.no_grad():
        observation = model.cpu()(signal).sample(generator=generator)
    mixture = PolynomialMixture(low, high, num_gaussians, num_coefficients)
    fit(mixture, signal, observation, digitise=False, num_steps=num_steps, learning_rate=3e-2, generator=generator)
    with atomic_path(path) as partial:
        np.savez(partial, **mixture.arrays())
    return kl_divergence(model, mixture, signal, seed=seed + 1)[0]


def _fitted_range(model: nn.Module) -> tuple[float, float]:
    for module in model.modules():
        if hasattr(module, "signal_low"):
            return float(module.signal_low), float(module.signal_high)  # type: ignore[arg-type]
    raise ValueError(
        f"{type(model).__name__} does not tell which signals it was fitted on; give signal_range=(low, high) in detector units"
    )


class PolynomialMixture(NoiseModelBase):
    """The noise model of PN2V (Prakash et al. 2020, arXiv:1911.12291) as CAREamics evaluates it.

    With t the signal from 0 at `low` to 1 at `high`: the variances are Σ exp(a_i)·tⁱ, the log-weights Σ b_i·tⁱ before they are
    normalised, and the means Σ c_i·tⁱ less their weighted mean, plus the signal.

    Args:
        low, high: range of the signals, detector units.
        num_gaussians, num_coefficients: see `to_pn2v_gmm`.
    """

    scale: Tensor

    def __init__(self, low: float, high: float, num_gaussians: int, num_coefficients: int) -> None:
        super().__init__()
        self.range = low, high
        place = torch.linspace(-1, 1, num_gaussians) if num_gaussians > 1 else torch.zeros(1)
        raw = torch.zeros(3, num_gaussians, num_coefficients)
        raw[0, :, 0], raw[1, :, 0], raw[1, :, 1:], raw[2, :, 0] = place, -0.5, -3.0, -place.abs()
        self.raw = nn.Parameter(raw)
        self.register_buffer("scale", torch.tensor(1.0))

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Measure the standard deviation of the noise, the unit of means and variances."""
        self.scale = (observation - signal).std(correction=0)

    def forward(self, signal: Tensor) -> MixtureDistribution:
        return MixtureDistribution(signal, self.components_at, model=self)

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-weights, means and log-scales at each signal, ``(*signal.shape, K)``."""
        low, high = self.range
        t = ((signal - low) / (high - low))[..., None, None]
        powers = t ** torch.arange(self.raw.shape[-1], device=signal.device)
        centre, log_weight = ((self.raw[row] * powers).sum(-1) for row in (0, 2))
        variance = (torch.exp(self.raw[1]) * powers).sum(-1).clamp(min=_LEAST_VARIANCE)
        log_weight = torch.log_softmax(log_weight, -1)
        centre = centre - (log_weight.exp() * centre).sum(-1, keepdim=True)
        log_scale = torch.log(self.scale) + 0.5 * torch.log(variance)
        return log_weight, signal[..., None] + self.scale * centre, log_scale

    def arrays(self) -> dict[str, Any]:
        """The arrays of the file: rows of means, log-variances and log-weights, (3·num_gaussians, num_coefficients)."""
        centre, log_variance, log_weight = self.raw.detach().cpu()
        scale = self.scale.cpu()
        rows = [scale * centre, log_variance + 2 * torch.log(scale), log_weight]
        return {
            "trained_weight": torch.cat(rows).float().numpy(),
            "min_signal": np.float32(self.range[0]),
            "max_signal": np.float32(self.range[1]),
            "min_sigma": np.float32(_LEAST_VARIANCE * float(scale) ** 2),
        }
