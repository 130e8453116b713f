"""Edges of the noise are found, densities there integrate to one, and other noise has no edge."""

from __future__ import annotations

import pytest
import torch

import noiseflow
from noiseflow.models.edged import ends_sharply
from tests.contracts import check_distribution, check_fixed_part, check_noise_model

SIGNALS = torch.linspace(0.2, 1.0, 5, dtype=torch.float64)


def pixels(count: int = 20_000) -> tuple[torch.Tensor, torch.Tensor]:
    """Signals and uniform numbers."""
    generator = torch.Generator().manual_seed(0)
    return 0.2 + 0.8 * torch.rand(count, generator=generator), torch.rand(count, generator=generator)


NOISES = {
    "between two edges": lambda uniform: uniform - 0.5,
    "above an edge": lambda uniform: -torch.log(uniform),
    "below an edge": lambda uniform: torch.log(uniform),
}


def fitted(name: str, count: int = 20_000) -> noiseflow.NoiseModelBase:
    signal, uniform = pixels(count)
    model = noiseflow.Edged(noiseflow.Mixture(8, shared_shape=True))
    noiseflow.fit(model, signal, signal + 0.2 * signal.sqrt() * NOISES[name](uniform))
    return model.double()


@pytest.mark.parametrize("name", NOISES)
def test_edged_noise_keeps_the_contract_and_integrates_to_one(name: str) -> None:
    model = fitted(name)
    check_noise_model(model, SIGNALS)
    check_distribution(model(SIGNALS))
    check_fixed_part(model, SIGNALS, model(SIGNALS).sample(generator=torch.Generator().manual_seed(1)))
    law = model(SIGNALS)
    inner = torch.linspace(-40, 40, 20_001, dtype=torch.float64)[:, None].expand(-1, 5)
    place = law.from_inner(inner)
    assert torch.allclose(law.to_inner(place)[0], inner, atol=1e-5)
    with torch.no_grad():
        slope = torch.exp(law.log_prob(place) - law.to_inner(place)[1])
        assert torch.allclose(torch.trapezoid(slope, inner, dim=0), torch.ones(5).double(), atol=1e-6)


@pytest.mark.parametrize("name", NOISES)
def test_edges_are_where_the_noise_ends(name: str) -> None:
    model, width = fitted(name), 0.2 * SIGNALS.sqrt()
    edges = {"between two edges": (-0.5, 0.5), "above an edge": (0.0, None), "below an edge": (None, 0.0)}[name]
    law = model(SIGNALS)
    for found, edge in zip((law._low, law._high), edges, strict=True):
        assert (found is None) == (edge is None)
        if edge is not None:
            assert torch.allclose(found, SIGNALS + edge * width, atol=2e-3)


def test_noise_between_edges_is_described_best_with_edges() -> None:
    signal, uniform = pixels()
    width = 0.2 * signal.sqrt()
    chosen = noiseflow.select(signal, signal + width * (uniform - 0.5)).chosen
    assert chosen.name == "Edged"
    # the entropy of a uniform law is the logarithm of its width
    assert chosen.nll == pytest.approx(float(width.log().mean()), abs=4e-3)


def test_only_noise_that_ends_has_an_edge() -> None:
    signal, uniform = pixels()
    normal = torch.special.ndtri(uniform.double()).float()
    assert ends_sharply(signal, signal + 0.1 * uniform)
    assert ends_sharply(signal, signal - 0.1 * signal * torch.log(uniform))
    assert ends_sharply(signal, signal - 0.1 * normal.abs())
    for noise in (normal, torch.sinh(normal), torch.log(uniform / (1 - uniform))):
        assert not ends_sharply(signal, signal + 0.1 * signal * noise)


def test_likelihood_has_finite_gradients_at_and_beyond_edges_and_signals_of_the_fit() -> None:
    model = fitted("between two edges")
    signal = torch.tensor([0.1, 0.2, 0.5, 0.5, 0.5, 1.0, 1.2], dtype=torch.float64, requires_grad=True)
    value = signal.detach() + torch.tensor([0.0, 0.0, 0.0, 0.2, -0.2, 0.0, 0.0])
    (gradient,) = torch.autograd.grad(model(signal).log_prob(value).sum(), signal)
    assert torch.isfinite(gradient).all()
    assert torch.isfinite(model(signal).log_prob(value)).all()


def test_edged_noise_is_saved_and_refuses_discrete_models(tmp_path) -> None:
    model = fitted("above an edge", 4000)
    again = noiseflow.load(noiseflow.save(model.float(), tmp_path / "edged.safetensors"))
    signal, value = torch.full((3,), 0.5), torch.tensor([0.49, 0.51, 0.9])
    assert torch.equal(again(signal).log_prob(value), model(signal).log_prob(value))
    with pytest.raises(ValueError, match="around Edged"):
        noiseflow.Edged(noiseflow.Poisson())
