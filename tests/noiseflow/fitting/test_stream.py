"""Pixels of data sets of any kind and size: all of them if they are few, else a uniform sample."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset, TensorDataset

from noiseflow import Gaussian, ScanNoise, fit, sample_pixels, select
from noiseflow.fitting import stream

SIGNAL = np.arange(600, dtype=np.uint16).reshape(6, 10, 10)


class Unsized(IterableDataset):
    """A data set without a length, whose loader has a length method that fails."""

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return ((one, 2 * one) for one in SIGNAL)


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
        "loader without length": (DataLoader(Unsized(), batch_size=2),),
        "generator": ((one, 2 * one) for one in SIGNAL),
    }


@pytest.mark.parametrize(
    "kind", ["mapped", "data set", "loader", "loader without length", "lists", "lists in batches", "generator"]
)
@pytest.mark.parametrize("block", [70, 10_000])
def test_every_source_gives_its_pixels(kind: str, block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "PART", block)
    source = sources(tmp_path)[kind]
    given = source if isinstance(source, tuple) else (source,)
    signal, observation = sample_pixels(*given)
    assert signal.tolist() == list(range(600))
    assert torch.equal(observation, 2 * signal)


class Chunked:
    """An array that counts how often each of its chunks is read, and the pixels read at once."""

    def __init__(self, data: np.ndarray, chunks: tuple[int, ...]) -> None:
        self.data, self.chunks, self.shape, self.ndim = data, chunks, data.shape, data.ndim
        self.reads = np.zeros([-(-n // c) for n, c in zip(data.shape, chunks, strict=True)], int)
        self.largest = 0

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, part: tuple[slice, ...]) -> np.ndarray:
        block = self.data[part]
        spans = [s.indices(n) for s, n in zip(part, self.shape, strict=True)]
        self.reads[tuple(slice(s[0] // c, -(-s[1] // c)) for s, c in zip(spans, self.chunks, strict=True))] += 1
        self.largest = max(self.largest, block.size)
        return block


@pytest.mark.parametrize("chunks", [(6, 4, 4), (4, 10, 2), (1, 10, 10), (1, 1, 3)])
def test_every_chunk_is_read_once_in_blocks_of_bounded_size(
    chunks: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "PART", 150)
    image, gain = Chunked(SIGNAL, chunks), np.arange(6.0).reshape(6, 1, 1)
    signal, observation, gains = sample_pixels(image, 2 * SIGNAL, gain)
    assert image.reads.tolist() == np.ones_like(image.reads).tolist()
    assert image.largest <= 150
    assert sorted(signal.tolist()) == list(range(600))
    assert torch.equal(observation, 2 * signal)
    assert torch.equal(gains, (signal // 100).double())


_WITHIN_LIMIT = """
import resource, sys, numpy as np, torch, noiseflow
from noiseflow.models import flow
open_array = np.load if sys.argv[1].endswith("npy") else __import__("zarr").open_array
options = {"mmap_mode": "r"} if sys.argv[1].endswith("npy") else {"mode": "r"}
signal, observation = (open_array(path, **options) for path in sys.argv[1:3])
noiseflow.fit(noiseflow.SignalDependentGaussian(), *noiseflow.sample_pixels(signal[:1], observation[:1], most=10_000))
held = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmData")) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (held + 2**29, -1))
try:
    np.ones(signal.shape, np.float32)
except MemoryError:
    pair = noiseflow.sample_pixels(signal, observation, most=2**20)
    print(float(noiseflow.fit(noiseflow.SignalDependentGaussian(), *pair).noise_model(torch.tensor(50.0)).stddev))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are those of Linux")
@pytest.mark.parametrize("kind", ["npy", "zarr"])
def test_a_fit_to_files_takes_less_memory_than_one_of_them(kind: str, tmp_path: Path) -> None:
    """1.7 GB of pixels, with 0.5 GB beyond what the library takes."""
    random, paths = np.random.default_rng(0), [tmp_path / f"{name}.{kind}" for name in ("signal", "observation")]
    clean = (10 + 90 * random.random((1, 1024, 1024))).astype(np.float32)
    shape = (208, 1024, 1024)
    if kind == "npy":
        files: list[Any] = [np.lib.format.open_memmap(path, "w+", np.float32, shape) for path in paths]
    else:
        zarr = pytest.importorskip("zarr")
        options = {"shape": shape, "chunks": (8, 256, 256), "dtype": "f4", "compressors": None}
        files = [zarr.create_array(path, **options) for path in paths]
    for start in range(0, shape[0], 8):
        noise = 3 * random.standard_normal((8, 1024, 1024), dtype=np.float32)
        files[0][start : start + 8], files[1][start : start + 8] = clean.repeat(8, 0), clean + noise
    del files
    command = [sys.executable, "-c", _WITHIN_LIMIT, *map(str, paths)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert float(found.stdout) == pytest.approx(3, rel=0.02)


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
    with pytest.raises(ValueError, match=r"give|mismatch"):
        sample_pixels(*source)


def test_fits_of_known_signals_take_a_sample_of_a_large_mapped_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MOST_LAZY", 4000)
    signal = np.linspace(1, 2, 20_000, dtype=np.float32).reshape(100, 200)
    np.save(
        tmp_path / "pair.npy", np.stack([signal, signal + 0.1 * np.random.default_rng(0).standard_normal((100, 200))])
    )
    pair = np.load(tmp_path / "pair.npy", mmap_mode="r")
    used = np.ones((100, 200), bool)
    used[:50] = False
    few = stream.bounded(Gaussian(), *pair, used, None, 0.1)
    assert [tuple(each.shape) for each in few[:3]] == [(4000,)] * 3
    assert bool((few[0][few[2]] > 1.5).all())
    assert few[3:] == [None, 0.1]
    found = fit(Gaussian(), *pair, mask=used, weights=np.ones((100, 200)))
    assert found.noise_model.log_scale.exp().item() == pytest.approx(0.1, rel=0.05)
    chosen = select(*pair, candidates={"Gaussian": Gaussian()}, mask=used).chosen
    assert chosen.model.log_scale.exp().item() == pytest.approx(0.1, rel=0.05)
    whole = stream.bounded(ScanNoise(Gaussian()), *pair, None)
    assert whole[0].shape == (100, 200)
    assert stream.bounded(Gaussian(), *map(np.ma.MaskedArray, pair))[0].shape == (100, 200)
