"""The pixels that judge a fit never train it, unused ones do neither, and a resumed fit draws on where it was."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import noiseflow
from noiseflow.fitting.pixels import FitPixels


def drawn(seed: int, shape: tuple[int, ...], share: float) -> tuple[torch.Tensor, torch.Tensor, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    observation = torch.rand(shape, generator=generator, dtype=torch.float64)
    use = torch.rand(observation.numel(), generator=generator) < share
    observation.view(-1)[~use] = math.nan
    return observation, use, generator


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.3, 1.0), given_mask=st.booleans())
def test_training_and_judging_pixels_divide_the_usable_ones(seed: int, share: float, given_mask: bool) -> None:
    observation, use, generator = drawn(seed, (9, 11), share)
    held_out = torch.rand(99, generator=generator) < 0.3 if given_mask else 0.3
    pixels = FitPixels.choose(observation, use, held_out, generator)
    train, judge = set(pixels.train.tolist()), set(pixels.judge.tolist())
    assert not train & judge
    assert train | judge == set(torch.nonzero(use).squeeze(1).tolist())
    if given_mask:
        assert judge == set(torch.nonzero(use & held_out).squeeze(1).tolist())
    weighted = set(torch.nonzero(pixels.weight).squeeze(1).tolist())
    assert weighted == train
    assert float(pixels.weight.sum()) == pytest.approx(1)
    assert bool(torch.isfinite(pixels.observation).all())
    assert set(pixels.batch(500).tolist()) <= train


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), axis=st.sampled_from([-1, -2]))
def test_lines_train_or_judge_as_a_whole_and_unused_pixels_are_marked(seed: int, axis: int) -> None:
    observation, use, generator = drawn(seed, (2, 12, 10), 0.8)
    pixels = FitPixels.choose_lines(observation, use, 0.3, generator, axis=axis)
    length = observation.shape[axis]
    assert pixels.train.shape[1] == pixels.judge.shape[1] == length
    every = torch.cat([pixels.train, pixels.judge]).reshape(-1)
    assert len(set(every.tolist())) == every.numel()
    step = 1 if axis == -1 else 10
    assert bool((pixels.train.diff(dim=1) == step).all())
    assert torch.equal(torch.isnan(pixels.observation), ~use)


def test_masked_pixels_do_not_move_a_fit() -> None:
    """Any values there, and the model that is fitted stays the same to the last bit."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(3000, generator=generator)
    observation = signal + 0.1 * torch.randn(3000, generator=generator)
    mask = torch.rand(3000, generator=generator) < 0.7
    found = []
    for spoilt in (observation, torch.where(mask, observation, 1e6), torch.where(mask, observation, math.nan)):
        torch.manual_seed(0)
        model = noiseflow.RadialFlow(2)
        fitted = noiseflow.fit(
            *(model, signal, spoilt),
            mask=mask,
            num_steps=10,
            digitise=False,
            generator=torch.Generator().manual_seed(1),
        )
        found.append((fitted.held_out_nll, torch.cat([p.detach().flatten() for p in model.parameters()])))
    for nll, parameters in found[1:]:
        assert nll == found[0][0]
        assert torch.equal(parameters, found[0][1])


def test_a_resumed_fit_draws_the_pixels_that_an_unbroken_one_would_have() -> None:
    """The resuming run brings a generator of another state; what is drawn next must come from the checkpoint."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(5000, generator=generator)
    observation = signal + 0.1 * torch.randn(5000, generator=generator)
    held_out = torch.rand(5000, generator=generator) < 0.1

    def fitted(seed: int, resume: dict[str, Any] | None = None) -> tuple[torch.Tensor, list[dict[str, Any]]]:
        model, states = noiseflow.Gaussian(1.0), []
        noiseflow.fit(
            *(model, signal, observation),
            num_steps=30,
            batch_size=64,
            digitise=False,
            standardise=False,
            held_out=held_out,
            generator=torch.Generator().manual_seed(seed),
            checkpoint=states.append,
            checkpoint_interval=0.0,
            resume=resume,
        )
        return torch.cat([parameter.detach().flatten() for parameter in model.parameters()]), states

    whole, states = fitted(1)
    assert not torch.equal(fitted(2)[0], whole)
    torch.testing.assert_close(fitted(2, states[2])[0], whole, rtol=0, atol=0)
