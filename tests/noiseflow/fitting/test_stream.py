"""Pixels of data sets of any kind and size: all of them if they are few, else a uniform sample."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

from noiseflow import sample_pixels
from noiseflow.fitting import stream

SIGNAL = np.arange(600, dtype=np.uint16).reshape(6, 10, 10)


def sources(folder: Path) -> dict[str, tuple[Any, ...]]:
    path = folder / "large.npy"
    np.save(path, SIGNAL)
    mapped = np.load(path, mmap_mode="r")
    tensors = TensorDataset(torch.arange(600.0).reshape(6, 10, 10), 2 * torch.arange(600.0).reshape(6, 10, 10))
    uneven = [SIGNAL[0], SIGNAL[1, :5], SIGNAL[1, 5:], SIGNAL[2:]]
    return {
        "mapped": (mapped, mapped * 2),
        "data set": (tensors,),
        "loader": (DataLoader(tensors, batch_size=4),),
        "lists": (uneven, [2 * each for each in uneven]),
        "lists in batches": (
            DataLoader([(each, 2 * each) for each in uneven], collate_fn=lambda b: list(zip(*b, strict=True))),
        ),
        "generator": ((one, 2 * one) for one in SIGNAL),
    }


@pytest.mark.parametrize("kind", ["mapped", "data set", "loader", "lists", "lists in batches", "generator"])
@pytest.mark.parametrize("block", [70, 10_000])
def test_every_source_gives_its_pixels(kind: str, block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "_BLOCK", block)
    source = sources(tmp_path)[kind]
    given = source if isinstance(source, tuple) else (source,)
    signal, observation = sample_pixels(*given)
    assert signal.tolist() == list(range(600))
    assert torch.equal(observation, 2 * signal)


def test_a_sample_is_uniform_over_blocks_of_unequal_size() -> None:
    images = [torch.full((size,), float(i)) for i, size in enumerate([40_000, 1000, 9000, 50_000])]
    signal, observation, gain = sample_pixels(
        ((one, one + 1, torch.tensor(i)) for i, one in enumerate(images)), most=10_000
    )
    assert signal.numel() == 10_000
    assert torch.equal(observation, signal + 1)
    assert torch.equal(gain.float(), signal)
    shares = torch.bincount(signal.long()) / 10_000
    assert shares.tolist() == pytest.approx([0.4, 0.01, 0.09, 0.5], abs=0.02)
    again = sample_pixels(((one, one + 1) for one in images), most=10_000)
    assert torch.equal(again[0], signal)


@pytest.mark.parametrize(
    "source",
    [
        ([],),
        ([torch.ones(3)],),
        ([(torch.ones(3), torch.ones(4))],),
        ([torch.ones(3)], [torch.ones(3)] * 2),
        (1.0, 2.0),
    ],
)
def test_what_is_no_data_set_is_refused(source: tuple[Any, ...]) -> None:
    with pytest.raises(ValueError, match=r"give|differ"):
        sample_pixels(*source)
