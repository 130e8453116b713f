"""Noise models for other programs: deepinv's noise model and data fidelity, the mixture file of PN2V and CAREamics.

How a composition works: an adapter takes any noise model, and answers with the other program's own interface or file.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.distributions.numerics.elementwise import PIECE
from noiseflow.fitting.fit import fit
from noiseflow.fitting.pixel_split import JUDGED_LAST
from noiseflow.installation import install_command
from noiseflow.io import atomic_path, check_output
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.mixture import NormalMixture
from noiseflow.models.wrapper import as_noise_model

_LEAST_VARIANCE = 1e-4  # relative to the variance of the noise


def to_deepinv(noise_model: nn.Module, *, seed: int = 0) -> Any:
    """Convert a noise model to a ``deepinv.physics.NoiseModel``, called as ``model(x, seed=None)``.

    Args:
        noise_model: the noise model; it is not copied.
        seed: seed of the generator for calls without a seed.

    Returns:
        A module for ``deepinv.physics.Physics(noise_model=…)``. Images have any shape and the detector units of the noise model.

    Raises:
        ModuleNotFoundError: deepinv is not installed.
    """
    model = as_noise_model(noise_model)
    return _deepinv().FittedNoise(model, torch.Generator(model.device).manual_seed(seed))


def to_deepinv_fidelity(noise_model: nn.Module) -> Any:
    """Convert the likelihood of a noise model to a ``deepinv.optim.DataFidelity``: −log p(y | A(x)), summed over each image.

    Args:
        noise_model: the noise model; it is not copied.

    Returns:
        The argument ``data_fidelity`` of deepinv's optimisers. Measurements have the detector units of the noise model.

    Raises:
        ModuleNotFoundError: deepinv is not installed.
    """
    return _deepinv().Likelihood(noise_model)


def _deepinv() -> Any:
    try:
        return import_module("noiseflow.interop.deepinv")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"this needs deepinv; install it with: {install_command('deepinv')}") from error


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
    """Approximate a noise model by the Gaussian-mixture model of PN2V and CAREamics, and write it to a file.

    A mixture whose means, variances and log-weights are polynomials of the signal is fitted to draws of the model. The mean of
    the mixture is the signal. The file format cannot describe digitisation or dependence on the pixel's position. For `Digitised`
    and `WithMaps`, the inner model is written; for `ScanNoise`, the distribution of single pixels; for models that depend on a
    neighbourhood, the distribution with uniform surroundings.

    Args:
        path: ``.npz`` file to write; ``GaussianMixtureNMConfig(path=…)`` of CAREamics reads it.
        signal_range: range of signals to cover, detector units; by default the range that the model was fitted on.
        num_steps: optimisation steps.

    Returns:
        Mean divergence of the mixture from the model over the signals, nats per pixel.

    Raises:
        ValueError: `signal_range` is empty, or not given although the model has no record of the signals it was fitted on.
    """
    path = check_output(path, suffixes=frozenset({".npz"}))
    model = as_noise_model(noise_model).without_converter()
    covered = signal_range or model.fitted_range
    if covered is None:
        raise ValueError(f"{type(model).__name__} has no fitted range; give signal_range=(low, high), detector units")
    low, high = covered
    if not low < high:
        raise ValueError(f"signal_range is {low:g} … {high:g}; the first value must be below the second")
    generator = torch.Generator().manual_seed(seed)
    signal = low + (high - low) * torch.rand(JUDGED_LAST, generator=generator)
    observation = _draws(model, signal, generator)
    mixture = PolynomialMixture(low, high, num_gaussians, num_coefficients)
    fit(mixture, signal, observation, digitise=False, num_steps=num_steps, learning_rate=3e-2, generator=generator)
    with atomic_path(path) as partial:
        np.savez(partial, **mixture.arrays())
    observation = _draws(model, signal, generator)  # independent of the draws used for fitting
    return float((_log_prob(model, signal, observation) - pixel_log_prob(mixture, signal, observation)).mean())


def _even(values: Tensor, model: NoiseModelBase) -> Tensor:
    """(N, k, k) uniform images with the values of (N,) pixels, as large as the window of the model."""
    return values.to(model.device)[:, None, None].expand(-1, model.neighbourhood, model.neighbourhood)


@torch.no_grad()
def _draws(model: NoiseModelBase, signal: Tensor, generator: torch.Generator) -> Tensor:
    """One observation for each of (N,) signals, on the CPU."""
    if model.device.type != "cpu":
        generator = torch.Generator(model.device).manual_seed(generator.initial_seed())
    if not model.needs_image:
        found: Tensor = model(signal.to(model.device)).sample(generator=generator).cpu()
        return found
    middle, parts = model.neighbourhood // 2, torch.split(signal, PIECE)
    drawn = [model(_even(part, model)).sample(generator=generator)[:, middle, middle] for part in parts]
    return torch.cat(drawn).cpu()


@torch.no_grad()
def _log_prob(model: NoiseModelBase, signal: Tensor, observation: Tensor) -> Tensor:
    """Log-density of each of (N,) independent observations, float64, on the CPU."""
    if not model.needs_image:
        return pixel_log_prob(model, signal.to(model.device), observation.to(model.device)).cpu()
    middle, parts = model.neighbourhood // 2, []
    for s, o in zip(torch.split(signal, PIECE), torch.split(observation, PIECE), strict=True):
        values = _even(o, model).clone()
        if model.shared_axis is not None:  # neighbours are set to NaN, so that the density is not conditional on them
            values.fill_(torch.nan)
            values[:, middle, middle] = o.to(values)
        parts.append(model(_even(s, model)).log_prob(values)[:, middle, middle].double().cpu())
    return torch.cat(parts)


class PolynomialMixture(NormalMixture):
    """The noise model of PN2V (Prakash et al. 2020, arXiv:1911.12291) as CAREamics evaluates it.

    Let t be the signal scaled to 0 at `low` and 1 at `high`. The variances are Σ exp(a_i)·tⁱ, the unnormalised log-weights
    Σ b_i·tⁱ, and the means Σ c_i·tⁱ minus their weighted mean plus the signal.

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

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
