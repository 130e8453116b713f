"""Arrays of every library: numbers as for tensors, and what else the array carries is kept."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import metrics
from noiseflow.arrays import as_tensor
from noiseflow.fitting import stream

SIGNAL = np.random.default_rng(0).uniform(110, 200, (6, 8, 10)).astype(np.float32)
MODEL = noiseflow.PoissonGaussian(2.0, 100.0, 1.2)
OBSERVATION = MODEL(torch.from_numpy(SIGNAL)).sample(generator=torch.Generator().manual_seed(0)).numpy()
LOG_PROB = MODEL(torch.from_numpy(SIGNAL)).log_prob(torch.from_numpy(OBSERVATION)).detach().numpy()


class OnlyArray:
    """An array known by ``__array__`` alone, as those of zarr."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.values, dtype)


class OnlyCapsule:
    """An array known by ``__dlpack__`` alone."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.values.__dlpack_device__()


@pytest.mark.parametrize("kind", [OnlyArray, OnlyCapsule])
def test_any_array_serves(kind: type) -> None:
    found = MODEL(kind(SIGNAL)).log_prob(kind(OBSERVATION))
    assert np.array_equal(found, LOG_PROB)
    assert metrics.evaluate(MODEL, kind(SIGNAL), kind(OBSERVATION)).nll == pytest.approx(-LOG_PROB.mean(), rel=1e-5)
    fitted = noiseflow.fit(noiseflow.Gaussian(), kind(SIGNAL), kind(OBSERVATION), num_steps=5)
    expected = noiseflow.fit(noiseflow.Gaussian(), SIGNAL, OBSERVATION, num_steps=5)
    assert fitted.held_out_nll == expected.held_out_nll


def test_numbers_and_lists_serve_as_signals() -> None:
    found = MODEL(150.0).log_prob(151), *MODEL([150.0]).log_prob([151.0])
    expected = float(MODEL(torch.tensor(150.0)).log_prob(torch.tensor(151.0)).detach())
    assert [float(each) for each in found] == pytest.approx([expected] * 2, rel=1e-6)
    lists = SIGNAL.ravel().tolist(), OBSERVATION.ravel().tolist()
    assert noiseflow.fit(noiseflow.Gaussian(), *lists, num_steps=5).noise_model.log_scale < 4


def test_masked_arrays_keep_their_mask() -> None:
    dim = np.ma.MaskedArray(SIGNAL, SIGNAL > 150)
    seen = np.ma.MaskedArray(OBSERVATION, OBSERVATION < 120)
    for found in (MODEL(dim).sample(), MODEL(dim).mean):
        assert np.array_equal(found.mask, dim.mask)
    both = dim.mask | seen.mask
    found = MODEL(dim).log_prob(seen)
    assert np.array_equal(found.mask, both)
    assert np.allclose(found.compressed(), LOG_PROB[~both], rtol=1e-5)


def test_masked_pixels_are_neither_fitted_nor_judged() -> None:
    mask = np.random.default_rng(1).random(SIGNAL.shape) < 0.3
    spoilt = np.ma.MaskedArray(np.where(mask, 1e6, OBSERVATION), mask)
    nll = metrics.evaluate(MODEL, SIGNAL, spoilt).nll
    assert nll == pytest.approx(-float(LOG_PROB[~mask].mean()), rel=1e-5)
    model = noiseflow.Gaussian()
    noiseflow.fit(model, SIGNAL, spoilt, num_steps=5)
    assert float(model.log_scale.detach().exp()) == pytest.approx(np.std((OBSERVATION - SIGNAL)[~mask]), rel=0.1)
    found = noiseflow.select(SIGNAL, spoilt, candidates={"Gaussian": noiseflow.Gaussian()}, num_steps=5)
    assert found.chosen.nll < 10


def test_masked_array_is_never_unmasked_in_silence() -> None:
    with pytest.raises(ValueError, match="masked"):
        as_tensor(np.ma.MaskedArray(SIGNAL, SIGNAL > 150))
    assert as_tensor(np.ma.MaskedArray(SIGNAL, False)).shape == SIGNAL.shape


def test_dask_stays_lazy_and_draws_the_same_again() -> None:
    array = pytest.importorskip("dask.array")
    lazy = array.from_array(SIGNAL, chunks=(2, 8, 10))
    distribution = MODEL(lazy)
    found = distribution.log_prob(OBSERVATION)
    assert isinstance(found, array.Array)
    assert found.chunks == lazy.chunks
    assert np.allclose(found.compute(scheduler="synchronous"), LOG_PROB, rtol=1e-6)
    draws = distribution.sample((2,), generator=torch.Generator().manual_seed(0))
    once, again = (draws.compute(scheduler="synchronous") for _ in range(2))
    assert np.array_equal(once, again)
    assert once.shape == (2, *SIGNAL.shape)
    assert np.unique(once).size > 0.99 * once.size  # no two blocks share their random numbers
    scores = metrics.pixel_log_prob(MODEL, lazy, array.from_array(OBSERVATION, chunks=(3, 8, 10)))
    assert isinstance(scores, array.Array)
    assert float(scores.mean().compute(scheduler="synchronous")) == pytest.approx(float(LOG_PROB.mean()), rel=1e-6)


def test_dask_arrays_are_judged_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    array = pytest.importorskip("dask.array")
    largest = []
    taken = stream.floating

    def recorded(block: Any) -> torch.Tensor:
        if not isinstance(block, torch.Tensor):  # tensors are pixels gathered before
            largest.append(np.size(block))
        return taken(block)

    monkeypatch.setattr(stream, "floating", recorded)
    lazy = [array.from_array(each, chunks=(2, 4, 10)) for each in (SIGNAL, OBSERVATION)]
    found = metrics.evaluate(MODEL, *lazy)
    blocks = list(largest)
    expected = metrics.evaluate(MODEL, SIGNAL, OBSERVATION)
    assert set(blocks) == {2 * 4 * 10}  # and never the whole
    assert found.num_pixels == expected.num_pixels
    assert found.nll == pytest.approx(expected.nll, rel=1e-6)
    assert found.overall.jsd == pytest.approx(expected.overall.jsd, rel=1e-3)
    mixed = metrics.evaluate(MODEL, lazy[0], OBSERVATION)
    assert mixed.nll == pytest.approx(expected.nll, rel=1e-6)


def test_of_large_dask_arrays_every_block_has_its_share_of_pixels() -> None:
    array = pytest.importorskip("dask.array")
    numbers = np.arange(4000.0).reshape(40, 100)
    lazy = array.from_array(numbers, chunks=(10, 50))
    signal, observation = stream.judged_pixels(lazy, lazy + 0.5, most=800)
    assert signal.numel() == 800
    assert torch.equal(observation, signal + 0.5)
    assert torch.histc(signal, 4, 0, 4000).tolist() == [200.0] * 4
    again = stream.judged_pixels(lazy, lazy + 0.5, most=800)[0]
    assert torch.equal(signal, again)


def test_masks_of_dask_arrays_are_kept() -> None:
    array = pytest.importorskip("dask.array")
    mask = SIGNAL > 150
    masked = array.ma.masked_array(array.from_array(OBSERVATION, chunks=(2, 8, 10)), mask)
    signal, _ = stream.judged_pixels(array.from_array(SIGNAL, chunks=(2, 8, 10)), masked)
    assert signal.numel() == int((~mask).sum())
    with pytest.raises(ValueError, match="shapes"):
        stream.judged_pixels(masked, SIGNAL[:1])


def test_dask_graph_can_travel() -> None:
    array = pytest.importorskip("dask.array")
    draws = noiseflow.SplineFlow()(array.zeros((4, 5), chunks=2) + 0.5).sample(
        generator=torch.Generator().manual_seed(0)
    )
    again = pickle.loads(pickle.dumps(draws))
    assert np.array_equal(*(each.compute(scheduler="synchronous") for each in (draws, again)))


def test_blocks_that_cut_images_are_refused_where_images_matter() -> None:
    array = pytest.importorskip("dask.array")
    rows = noiseflow.ScanNoise(noiseflow.Gaussian(2.0))
    with pytest.raises(ValueError, match="rechunk"):
        rows(array.from_array(SIGNAL, chunks=(2, 4, 10)))
    found = rows(array.from_array(SIGNAL, chunks=(2, 8, 10))).log_prob(OBSERVATION).compute(scheduler="synchronous")
    expected = rows(torch.from_numpy(SIGNAL)).log_prob(torch.from_numpy(OBSERVATION)).detach().numpy()
    assert np.allclose(found, expected, atol=1e-3)


def test_xarray_keeps_its_coordinates() -> None:
    xarray = pytest.importorskip("xarray")
    given = xarray.DataArray(SIGNAL, dims=("time", "y", "x"), coords={"time": np.arange(6) * 0.5}, name="counts")
    for found in (MODEL(given).sample(), MODEL(given).log_prob(given.copy(data=OBSERVATION))):
        assert found.dims == given.dims
        assert found.name == "counts"
        assert np.array_equal(found.time, given.time)
    assert np.array_equal(MODEL(given).log_prob(OBSERVATION).values, LOG_PROB)
    assert MODEL(given).sample((3,)).dims == ("draw", "time", "y", "x")


def test_pandas_keeps_its_index() -> None:
    pandas = pytest.importorskip("pandas")
    given = pandas.Series(SIGNAL[0, 0], index=list("abcdefghij"), name="counts")
    found = MODEL(given).log_prob(OBSERVATION[0, 0])
    assert list(found.index) == list(given.index)
    assert np.array_equal(found.to_numpy(), LOG_PROB[0, 0])
