"""The pixels that judge a fit never train it, unused ones do neither, and a resumed fit draws on where it was."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import noiseflow
from noiseflow.fitting.pixel_split import FitPixels, thinned


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


class ByBatches(noiseflow.Gaussian):
    """Gaussian noise that is trained on batches, as models of images are."""

    fits_directly = False


def test_a_resumed_fit_draws_the_pixels_that_an_unbroken_one_would_have() -> None:
    """The resuming run brings a generator of another state; what is drawn next must come from the checkpoint."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(5000, generator=generator)
    observation = signal + 0.1 * torch.randn(5000, generator=generator)
    held_out = torch.rand(5000, generator=generator) < 0.1

    def fitted(seed: int, resume: dict[str, Any] | None = None) -> tuple[torch.Tensor, list[dict[str, Any]]]:
        model, states = ByBatches(1.0), []
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


def test_batches_are_as_large_as_asked_for_and_half_a_line_trains() -> None:
    observation, use, generator = drawn(0, (2, 12, 10), 2.0)
    assert FitPixels.choose(observation, use, 0.2, generator).batch(50).shape == (50,)
    half = torch.zeros(observation.shape, dtype=torch.bool)
    half[0, 3, :5] = half[0, 4, :6] = True
    lines = FitPixels.choose_lines(observation, use, half, generator, axis=-1)
    assert lines.judge.tolist() == [list(range(40, 50))]
    assert lines.batch(50).shape == (5, 10)


@pytest.mark.parametrize("held_out", [[False] * 12, [True] * 11 + [False]])
def test_too_few_pixels_to_train_or_to_judge_are_refused(held_out: list[bool]) -> None:
    observation, use, generator = drawn(0, (12,), 2.0)
    with pytest.raises(ValueError, match="too few"):
        FitPixels.choose(observation, use, torch.tensor(held_out), generator)


def test_two_pixels_to_train_and_one_to_judge_are_enough() -> None:
    observation, use, generator = drawn(0, (3,), 2.0)
    pixels = FitPixels.choose(observation, use, torch.tensor([False, True, False]), generator)
    assert (pixels.train.tolist(), pixels.judge.tolist()) == ([0, 2], [1])
    assert pixels.weight.tolist() == [0.5, 0.0, 0.5]
    for held_out in ([True, True, False], [False, False, False]):
        with pytest.raises(ValueError, match="3 usable pixels are too few"):
            FitPixels.choose(observation, use, torch.tensor(held_out), generator)


@pytest.mark.parametrize("count", [(3, 1), (2, 1), (2, 2)])
def test_two_lines_to_train_and_one_to_judge_are_enough(count: tuple[int, int]) -> None:
    train, judge = count
    observation, use, generator = drawn(0, (1, train + judge, 4), 2.0)
    held_out = torch.zeros(observation.shape, dtype=torch.bool)
    held_out[0, train:] = True
    pixels = FitPixels.choose_lines(observation, use, held_out, generator, axis=-1)
    assert (len(pixels.train), len(pixels.judge)) == count
    for rows in (slice(1, None), slice(0, 0)):
        held_out[:] = False
        held_out[0, rows] = True
        with pytest.raises(ValueError, match="usable rows or columns are too few"):
            FitPixels.choose_lines(observation, use, held_out, generator, axis=-1)


def test_lines_without_a_usable_pixel_are_left_out_and_others_stay_whole() -> None:
    observation, use, generator = drawn(0, (2, 5, 4), 2.0)
    use = use.view(2, 5, 4).clone()
    use[0, 2] = False
    use[1, 3, 1:] = False
    held_out = torch.zeros(2, 5, 4, dtype=torch.bool)
    held_out[1, 3] = True
    pixels = FitPixels.choose_lines(observation, use.reshape(-1), held_out, generator, axis=-1)
    assert pixels.judge.tolist() == [[32, 33, 34, 35]]
    assert len(pixels.train) == 8
    assert not set(range(8, 12)) & set(pixels.train.reshape(-1).tolist())
    assert pixels.image == (5, 4)
    assert not pixels.weight.any()


def test_unusable_pixels_get_the_mean_of_the_usable() -> None:
    observation = torch.tensor([1.0, math.nan, 5.0, 3.0, 100.0, math.inf])
    use = torch.tensor([True, False, True, True, False, False])
    held_out = torch.tensor([False, False, False, True, False, False])
    pixels = FitPixels.choose(observation, use, held_out, torch.Generator())
    assert pixels.observation.tolist() == [1.0, 3.0, 5.0, 3.0, 100.0, 3.0]


@pytest.mark.parametrize("share", [0.1, 0.6])
def test_as_many_pixels_judge_as_are_asked_for(share: float) -> None:
    use = torch.ones(20_000, dtype=torch.bool)
    pixels = FitPixels.choose(torch.zeros(20_000), use, share, torch.Generator().manual_seed(0))
    assert pixels.judge.numel() / 20_000 == pytest.approx(share, abs=0.015)


def test_batches_hold_every_training_pixel_alike_and_are_never_empty() -> None:
    observation, use, generator = drawn(0, (40,), 2.0)
    pixels = FitPixels.choose(observation, use, 0.3, generator)
    batch = torch.cat([pixels.batch(20) for _ in range(400)])
    counts = torch.bincount(batch, minlength=40)[pixels.train]
    assert float(counts.min()) > 0.7 * float(counts.float().mean())
    assert pixels.batch(10**6).numel() == pixels.train.numel()
    lines = FitPixels.choose_lines(observation.reshape(1, 8, 5), use, torch.arange(40) < 10, generator, axis=-1)
    assert lines.batch(3).shape == (1, 5)
    assert lines.batch(10**6).shape == (len(lines.train), 5)


@pytest.mark.parametrize(("most", "expected"), [(10, 10), (11, 10), (9, 5), (4, 4), (3, 3), (1, 1)])
def test_thinning_keeps_at_most_so_many_evenly(most: int, expected: int) -> None:
    found = thinned(torch.arange(10), most)
    assert len(found) == expected <= most
    assert len(set(found.diff().tolist())) <= 1
    assert found[0] == 0
    assert thinned(torch.arange(40).view(10, 4), 20).shape == (5, 4)
