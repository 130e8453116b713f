"""The known noises are what they claim; rivals are densities."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.divergences import kl_divergence

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def content() -> dict[str, Any]:
    found: dict[str, Any] = json.loads((BENCHMARKS / "results" / "noise_models.json").read_text(encoding="utf-8"))
    return found


def test_figure_draws_from_part_of_the_rows(tmp_path: Path) -> None:
    from benchmarks.pages import noise_figure

    part = content()
    part["accuracy"] = part["accuracy"][:3]
    part.pop("speed", None)
    noise_figure.draw(part).savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_a_row_is_replaced_and_the_file_is_whole_after_each(tmp_path: Path) -> None:
    from benchmarks.pages import noise_models

    results = noise_models.Results(tmp_path / "rows.json")
    for kl in (0.5, 0.25):
        results.put("accuracy", {"noise": "gamma", "model": "zuko", "kl": kl}, "noise", "model")
    results.put("accuracy", {"noise": "gaussian", "model": "zuko", "kl": 1.0}, "noise", "model")
    again = noise_models.Results(tmp_path / "rows.json")
    assert [row["kl"] for row in again.content["accuracy"]] == [0.25, 1.0]
    assert again.find("accuracy", noise="gaussian", kl=1.0) is not None
    assert again.find("accuracy", noise="clipped") is None


@pytest.mark.parametrize("as_published", [False, True])
def test_the_papers_density_integrates_to_one_only_with_the_right_derivative(as_published: bool) -> None:
    from benchmarks.pages.noise_rivals import PaperFlow

    flow = PaperFlow(as_published=as_published)
    integral = flow.integral(0.5)
    assert abs(integral - 1) > 0.2 if as_published else integral == pytest.approx(1, abs=1e-3)


def rivals() -> list[Any]:
    pytest.importorskip("zuko")
    pytest.importorskip("normflows")
    from benchmarks.pages import noise_rivals

    return [
        *(noise_rivals.make(name, {})[0] for name in noise_rivals.SETTINGS),
        noise_rivals.PaperFlow(as_published=False),
    ]


def test_rivals_are_normalised_and_invertible() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(4000, generator=generator)
    observation = signal + 0.1 * torch.randn(signal.shape, generator=generator)
    for rival in rivals():
        rival.standardise(signal, observation)
        grid = torch.linspace(-20, 20, 40_001)
        with torch.no_grad():
            distribution = rival(torch.full_like(grid, 0.3))
            assert float(torch.trapezoid(distribution.log_prob(grid).exp(), grid)) == pytest.approx(1, abs=5e-3)
            middle = rival(signal)
            there = middle.to_latent(observation)[0]
            assert float((middle.from_latent(there) - observation).abs().max()) < 1e-3


@torch.no_grad()
def test_known_noises_have_the_likelihood_of_their_samples() -> None:
    """E[log p] of samples is the negative entropy, so another density of the same samples is less likely."""
    import noiseflow
    from benchmarks.pages import noise_truths

    for name, noise in noise_truths.noises().items():
        clean = noise_truths.clean_image(*noise.signals, 64).reshape(-1).repeat(4)
        sample = noise.model(clean).sample(generator=torch.Generator().manual_seed(0))
        assert bool(torch.isfinite(noise.model(clean).log_prob(sample)).all()), name
        shift = 0.3 * float((sample - clean).std())
        moved = (sample + shift).clamp(0, 1) if isinstance(noise.model, noiseflow.Digitised) else sample + shift
        divergence, error = kl_divergence(noise.model, noise.model, clean)
        assert (divergence, error) == (0, 0), name
        own, other = (float(noise.model(clean).log_prob(each).mean()) for each in (sample, moved))
        assert own > other or not math.isfinite(other), name


def test_a_missing_rival_is_told_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.pages import noise_rivals

    monkeypatch.setitem(sys.modules, "zuko", None)
    with pytest.raises(SystemExit, match=r"pip install '\.\[benchmark\]'"):
        noise_rivals.make("zuko", {})
