"""Noise models for other programs: deepinv's noise model and data fidelity, the mixture file of PN2V and CAREamics."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.fitting.fit import fit
from noiseflow.io import atomic_path, check_output
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models.around import as_noise_model
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.mixture import MixtureDistribution

_NUM_PIXELS, _AT_ONCE = 100_000, 8192
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
    model = as_noise_model(noise_model)
    return _deepinv().FittedNoise(model, torch.Generator(model.device).manual_seed(seed))


def to_deepinv_fidelity(noise_model: nn.Module) -> Any:
    """A noise model's likelihood as a ``deepinv.optim.DataFidelity``: −log p(y | A(x)), summed over each image.

    Args:
        noise_model: the model; it is not copied.

    Returns:
        What deepinv's optimisers take as ``data_fidelity``. Measurements are in the noise model's detector units.

    Raises:
        ModuleNotFoundError: deepinv is not installed.
    """
    return _deepinv().Likelihood(noise_model)


def _deepinv() -> Any:
    try:
        return import_module("noiseflow.interop.deepinv")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("this needs deepinv; python -m pip install 'noiseflow[deepinv]'") from error


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

    A mixture whose means, variances and log-weights are polynomials of the signal is fitted to draws of the model, whichever that
    is. The file's form leaves out what the pixel's place decides and what the converter does: of a `Digitised` or `WithMaps`
    model, the model inside is written; of `ScanNoise`, the law of single pixels; of one that looks at a neighbourhood, that of
    even surroundings. The mean of the mixture is the signal.

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
    model = as_noise_model(noise_model).without_converter()
    low, high = _fitted_range(model) if signal_range is None else signal_range
    if not low < high:
        raise ValueError(f"signal_range is {low:g} … {high:g}; the first must lie below the second")
    generator = torch.Generator().manual_seed(seed)
    signal = low + (high - low) * torch.rand(_NUM_PIXELS, generator=generator)
    observation = _draws(model, signal, generator)
    mixture = PolynomialMixture(low, high, num_gaussians, num_coefficients)
    fit(mixture, signal, observation, digitise=False, num_steps=num_steps, learning_rate=3e-2, generator=generator)
    with atomic_path(path) as partial:
        np.savez(partial, **mixture.arrays())
    observation = _draws(model, signal, generator)  # others than those it was fitted to
    return float((_log_prob(model, signal, observation) - pixel_log_prob(mixture, signal, observation)).mean())


def _fitted_range(model: NoiseModelBase) -> tuple[float, float]:
    if model.fitted_range is None:
        raise ValueError(
            f"{type(model).__name__} does not say which signals it was fitted on; give signal_range=(low, high) in detector units"
        )
    return model.fitted_range


def _even(values: Tensor, model: NoiseModelBase) -> Tensor:
    """(N, k, k) even images around pixels (N,), as large as the window that the model looks at."""
    return values.to(model.device)[:, None, None].expand(-1, model.neighbourhood, model.neighbourhood)


@torch.no_grad()
def _draws(model: NoiseModelBase, signal: Tensor, generator: torch.Generator) -> Tensor:
    """One observation for each of (N,) signals, on the CPU."""
    if model.device.type != "cpu":
        generator = torch.Generator(model.device).manual_seed(generator.initial_seed())
    if not model.needs_image:
        found: Tensor = model(signal.to(model.device)).sample(generator=generator).cpu()
        return found
    middle, parts = model.neighbourhood // 2, torch.split(signal, _AT_ONCE)
    drawn = [model(_even(part, model)).sample(generator=generator)[:, middle, middle] for part in parts]
    return torch.cat(drawn).cpu()


@torch.no_grad()
def _log_prob(model: NoiseModelBase, signal: Tensor, observation: Tensor) -> Tensor:
    """Log-density of each of (N,) observations by itself, float64, on the CPU."""
    if not model.needs_image:
        return pixel_log_prob(model, signal.to(model.device), observation.to(model.device)).cpu()
    middle, parts = model.neighbourhood // 2, []
    for s, o in zip(torch.split(signal, _AT_ONCE), torch.split(observation, _AT_ONCE), strict=True):
        values = _even(o, model).clone()
        if model.shared_axis is not None:  # those beside are missing, or the pixel's density would be that given them
            values.fill_(torch.nan)
            values[:, middle, middle] = o.to(values)
        parts.append(model(_even(s, model)).log_prob(values)[:, middle, middle].double().cpu())
    return torch.cat(parts)


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
