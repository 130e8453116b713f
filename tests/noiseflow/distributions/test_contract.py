"""Every model's distribution is a torch distribution in full, in every number type and shape; one contract for all."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Binomial, Distribution, Gamma, Poisson, StudentT

import noiseflow
from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.numerics.monotone_maps import Affine
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.models.wrapper import as_noise_model
from recon.methods.kniesel2022 import PaperFlow
from tests.contracts import (
    check_bad_values,
    check_distribution,
    check_draws_with_gradient,
    check_functional_transforms,
    check_number_types,
    check_shapes,
)


class Skewed(torch.nn.Module):
    """A plain torch distribution: all but the density, the draws and the moments is made numerically."""

    def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:
        signal = signal if signal.is_floating_point() else signal.float()
        return torch.distributions.Gumbel(
            signal - 0.05 * 0.5772156649015329, torch.full_like(signal, 0.05), validate_args=False
        )


def detector(read_noise: float) -> noiseflow.PoissonGaussian:
    return noiseflow.PoissonGaussian(0.05, -0.02, read_noise)


MODELS = {
    "Gaussian": lambda: noiseflow.Gaussian(),
    "Poisson": lambda: noiseflow.Poisson(0.05, -0.2),
    "spread Poisson": lambda: noiseflow.Poisson(0.05, -0.2, spread=True),
    "signal-dependent Gaussian": lambda: noiseflow.SignalDependentGaussian(),
    "radial": lambda: noiseflow.RadialFlow(mean_preserving=True),
    "spline": lambda: noiseflow.SplineFlow(),
    "mixture": lambda: noiseflow.Mixture(),
    "outliers": lambda: noiseflow.GaussianWithOutliers(),
    "Poisson-Gaussian": lambda: detector(0.9),
    "Poisson-Gaussian, smooth": lambda: detector(2.5),
    "physics and flow": lambda: noiseflow.PhysicsFlow(detector=detector(0.9)),
    "8-bit Gaussian": lambda: noiseflow.Digitised(noiseflow.Gaussian(), 1 / 128, 0.0, 1.0),
    "8-bit spline": lambda: noiseflow.Digitised(noiseflow.SplineFlow(), 1 / 128, 0.0, 1.0),
    "8-bit detector": lambda: noiseflow.Digitised(detector(0.9), 1 / 128, 0.0, 1.0),
    "8-bit physics": lambda: noiseflow.Digitised(noiseflow.PhysicsFlow(detector=detector(0.9)), 1 / 128, 0.0, 1.0),
    "8-bit counts": lambda: noiseflow.Digitised(noiseflow.Poisson(1 / 16), 1 / 16, 0.0, 1.0),
    "clipped spline": lambda: noiseflow.Digitised(noiseflow.SplineFlow(), 0.0, 0.0, 1.0),
    "clipped detector": lambda: noiseflow.Digitised(detector(0.9), 0.0, 0.0, 1.0),
    "stuck pixels": lambda: noiseflow.StuckPixels(
        noiseflow.Digitised(noiseflow.Gaussian(), 1 / 128, 0.0, 1.0), 0.0, 0.1
    ),
    "zeros": lambda: noiseflow.StuckPixels(noiseflow.Gaussian(), 0.0, (0.3, 0.1)),
    "edged": lambda: noiseflow.Edged(noiseflow.Gaussian()),
    "wrapped": lambda: noiseflow.Wrapped(noiseflow.Gaussian(), 0.0, 1.0),
    "8-bit wrapped": lambda: noiseflow.Digitised(noiseflow.Wrapped(noiseflow.Gaussian(), 0.0, 1.0), 1 / 128, 0.0, 1.0),
    "plain torch": lambda: as_noise_model(Skewed()),
    "8-bit plain torch": lambda: noiseflow.Digitised(Skewed(), 1 / 128, 0.0, 1.0),
    "clipped plain torch": lambda: noiseflow.Digitised(Skewed(), 0.0, 0.0, 1.0),
}
SIGNALS = torch.tensor([0.05, 0.4, 0.97])


@pytest.mark.parametrize("name", MODELS)
def test_distribution_is_complete(name: str) -> None:
    check_distribution(MODELS[name]().double()(SIGNALS.double()))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    ("parameters", "dtype"),
    [
        *((False, dtype) for dtype in (torch.float16, torch.bfloat16, torch.float32)),
        *((True, dtype) for dtype in (torch.float16, torch.bfloat16)),  # in single precision they are
    ],
    ids=lambda value: (
        str(value).removeprefix("torch.")
        if isinstance(value, torch.dtype)
        else "images and parameters"
        if value
        else "images"
    ),
)
def test_every_number_type_answers_as_double_precision_within_its_rounding(
    name: str, dtype: torch.dtype, parameters: bool
) -> None:
    model = MODELS[name]()
    check_number_types(model.to(dtype) if parameters else model, SIGNALS.to(dtype))


@pytest.mark.parametrize("name", MODELS)
def test_scalars_broadcasting_and_nothing_at_all(name: str) -> None:
    check_shapes(MODELS[name](), SIGNALS)


@pytest.mark.parametrize("name", MODELS)
def test_what_is_no_number_or_impossible_is_said_to_be(name: str) -> None:
    check_bad_values(MODELS[name](), SIGNALS)


@pytest.mark.parametrize("name", MODELS)
def test_draws_follow_signal_and_parameters(name: str) -> None:
    check_draws_with_gradient(MODELS[name]().double(), SIGNALS.double())


@pytest.mark.parametrize("name", [name for name in MODELS if name not in ("Poisson", "8-bit counts")])
def test_functional_transforms_agree_with_differences(name: str) -> None:
    check_functional_transforms(MODELS[name]().double(), SIGNALS.double())


class InAList(LatentDistribution):
    """A distribution with tensors where splitting does not find them."""

    def __init__(self, signal: torch.Tensor, layers: list[Affine]) -> None:
        super().__init__(signal.shape)
        self.signal, self.layers = signal, layers

    def to_latent(self, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.layers[0].forward(value)

    def from_latent(self, latent: torch.Tensor) -> torch.Tensor:
        return self.layers[0].inverse(latent)[0]


class Listing(noiseflow.NoiseModelBase):
    """Its scale follows the signal."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(0.1))

    def forward(self, signal: torch.Tensor) -> InAList:
        return InAList(signal, [Affine(signal, torch.log(self.scale + 0.1 * signal))])


MANY = {
    name: MODELS[name] for name in ("radial", "spline", "mixture", "8-bit spline", "8-bit detector", "physics and flow")
}
MANY |= {"published flow": PaperFlow, "tensors in a list": Listing}


@pytest.mark.parametrize("name", MANY)
def test_many_pixels_have_the_likelihood_and_gradient_of_few(name: str) -> None:
    """Large inputs are evaluated in pieces, whose graphs are made again in the backward pass."""
    from noiseflow.distributions.numerics.tables import LARGE

    torch.manual_seed(0)  # of the weights of networks
    model, generator = MANY[name](), torch.Generator().manual_seed(0)
    few = torch.rand(4000, generator=generator)
    count = LARGE // 4000 + 1
    with torch.no_grad():
        seen = model(few).sample(generator=generator)
    gradients = []
    for repeated, weight in ((1, 1.0), (count, 1 / count)):
        signal = few.clone().requires_grad_()
        parameters = [p for p in model.parameters() if p.requires_grad]
        found = model(signal.expand(repeated, -1)).log_prob(seen.expand(repeated, -1))
        gradients.append(torch.autograd.grad(weight * found.sum(), [signal, *parameters]))
    for one, many in zip(*gradients, strict=True):
        torch.testing.assert_close(many, one, rtol=2e-3, atol=2e-3 * float(one.abs().max()))


@pytest.mark.parametrize(("low", "high"), [(0.0, 10.4), (0.0, 10.0), (-math.inf, 3.7), (0.3, 7.1), (0.0, math.inf)])
def test_masses_sum_to_one_wherever_the_limits_lie(low: float, high: float) -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(3.0), 1.0, low, high).double()
    origin = low if math.isfinite(low) else 0.0
    levels = origin + torch.arange(-60.0, 60.0, dtype=torch.float64)
    inner = levels[(levels >= low) & (levels < high - 1e-9)]
    possible = torch.cat([inner, torch.tensor([high], dtype=torch.float64)]) if math.isfinite(high) else inner
    masses = model(torch.full_like(possible, 8.2)).log_prob(possible).exp()
    assert float(masses.sum().detach()) == pytest.approx(1, abs=1e-9)
    at = model(torch.full_like(possible, 8.2))
    assert torch.allclose(at.cdf(possible) - at.cdf_below(possible), masses, atol=1e-9)
    drawn = model(torch.full((2000,), 8.2, dtype=torch.float64)).sample(generator=torch.Generator().manual_seed(0))
    assert bool((drawn[:, None] == possible).any(1).all())


def test_large_values_in_single_precision_keep_their_cells() -> None:
    """At 10⁷ neighbouring single-precision numbers are one step apart."""
    model = noiseflow.Digitised(noiseflow.Gaussian(3.0), 1.0)
    observation = 1e7 + torch.arange(-5.0, 6.0)
    found = model(torch.full_like(observation, 1e7)).log_prob(observation)
    exact = model.double()(torch.full_like(observation, 1e7).double()).log_prob(observation.double())
    assert found.dtype == torch.float32
    assert torch.allclose(found.double(), exact, atol=1e-5)


def test_a_camera_in_half_precision() -> None:
    model = noiseflow.Digitised(noiseflow.PoissonGaussian(2, 100, 1.2), 1, 0, 65535)
    signal = torch.full((1,), 150.0)
    for dtype in (torch.bfloat16, torch.float16):
        found = model(signal.to(dtype)).log_prob(signal.to(dtype))
        assert found.dtype == dtype
        assert float(found.detach()) == pytest.approx(float(model(signal).log_prob(signal).detach()), rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spline", "radial"])
def test_flows_compile_without_graph_breaks(name: str) -> None:
    model, signal = MODELS[name](), torch.rand(100, generator=torch.Generator().manual_seed(0))

    def both(signal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        distribution = model(signal)
        return distribution.log_prob(signal + 0.1), distribution.sample()

    torch._dynamo.reset()
    explained = torch._dynamo.explain(both)(signal)
    assert explained.graph_break_count == 0
    compiled = torch.compile(both, backend="aot_eager", fullgraph=True)
    found, drawn = compiled(signal)
    assert torch.allclose(found, both(signal)[0], atol=1e-5)
    assert drawn.shape == signal.shape


def test_pixels_along_another_axis_than_the_first_are_not_mixed_up():
    """A mixture that keeps its components along a leading axis: many pixels at once are as the same pixels one by one."""
    from recon.simulate.noises import OutlierNoise

    signal = torch.linspace(0, 1, 64)[:, None]
    values = torch.randn(64, 5000, generator=torch.Generator().manual_seed(0))
    whole = OutlierNoise()(signal).log_prob(values)
    assert torch.allclose(whole[:, :7], OutlierNoise()(signal).log_prob(values[:, :7]))


_ONE, _THREE = torch.tensor([1.0, 3.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("law", "reference"),
    [
        (StudentT(4 * _ONE, _ONE, _THREE), stats.t(4, 1, 3)),
        (StudentT(2.1 * _ONE, _ONE, _THREE), stats.t(2.1, 1, 3)),
        (Gamma(_THREE, _ONE), stats.gamma(3)),
        (Poisson(_THREE), stats.poisson(3)),
        (Binomial(10, _ONE / 4), stats.binom(10, 0.25)),
    ],
    ids=["Student", "Student, heavy tails", "Gamma", "Poisson", "binomial"],
)
def test_quantiles_that_torch_has_not_are_those_of_scipy(law: Distribution, reference: Any) -> None:
    levels = np.array([1e-6, 0.01, 0.2, 0.5, 0.9, 0.99, 1 - 1e-4])  # the quadrature of the CDF errs by up to 2e-9
    found = as_noise_distribution(law).icdf(torch.from_numpy(levels))
    np.testing.assert_allclose(found, reference.ppf(levels), rtol=1e-4)
