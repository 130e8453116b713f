"""Noise in training pipelines: every model can be pickled, spawned workers draw noise of their own, nestings come back."""

from __future__ import annotations

import copy
import io
import pickle

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import noiseflow
from noiseflow.io.model_files import kinds
from noiseflow.transforms import AddNoise

IMAGE = torch.full((1, 16, 16), 0.5)
WRAPPERS = {
    "AtLevel": lambda: noiseflow.AtLevel(noiseflow.SplineFlow(), 100.0),
    "Correlated": lambda: noiseflow.Correlated(noiseflow.RadialFlow(), torch.ones(1, 3)),
    "Digitised": lambda: noiseflow.Digitised(noiseflow.PhysicsFlow(), 0.1, 0.0, 1.0),
    "Edged": lambda: noiseflow.Edged(noiseflow.SplineFlow()),
    "Wrapped": lambda: noiseflow.Wrapped(noiseflow.SplineFlow(), 0.0, 1.0),
    "StuckPixels": lambda: noiseflow.StuckPixels(noiseflow.Poisson(0.1), 0.0, 0.1),
    "ScanNoise": lambda: noiseflow.ScanNoise(noiseflow.SplineFlow()),
    "WithMaps": lambda: noiseflow.WithMaps(noiseflow.RadialFlow(neighbourhood=3), torch.ones(16, 16)),
}
OWN = sorted(
    name for name, kind in kinds().items() if kind.__module__.startswith("noiseflow.") and name != "Conditioned"
)


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("way", ["pickle", "torch.save", "deepcopy"])
def test_every_model_can_be_copied(name: str, way: str) -> None:
    model = WRAPPERS[name]() if name in WRAPPERS else kinds()[name]()
    value = torch.full_like(IMAGE, 0.4)
    before = model(IMAGE).log_prob(value)
    if way == "pickle":
        again = pickle.loads(pickle.dumps(model))
    elif way == "deepcopy":
        again = copy.deepcopy(model)
    else:
        stream = io.BytesIO()
        torch.save(model, stream)
        stream.seek(0)
        again = torch.load(stream, weights_only=False)
    assert torch.equal(again(IMAGE).log_prob(value), before)


def test_copy_of_a_model_follows_its_own_parameters() -> None:
    model = noiseflow.Mixture(mean_preserving=True)
    with torch.no_grad():
        before = model(IMAGE).log_prob(IMAGE)
        again = pickle.loads(pickle.dumps(model))
        again.bias[0] += torch.tensor([1.0, 0.0, 0.0])
        shifted = again(IMAGE)
        assert torch.allclose(shifted.mean, IMAGE, atol=1e-3)
        assert not torch.equal(shifted.log_prob(IMAGE), before)
        assert torch.equal(model(IMAGE).log_prob(IMAGE), before)


class CleanImages(Dataset):
    """Eight equal clean images made noisy."""

    def __init__(self, transform: AddNoise) -> None:
        self.transform = transform

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> Tensor:
        return self.transform(IMAGE)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [None, 5])
def test_spawned_workers_draw_noise_of_their_own(seed: int | None) -> None:
    def epochs() -> list[Tensor]:
        torch.manual_seed(0)
        transform = AddNoise(noiseflow.SplineFlow(), seed=seed)
        loader = DataLoader(CleanImages(transform), batch_size=4, num_workers=2, multiprocessing_context="spawn")
        return [torch.cat(list(loader)) for _ in range(2)]

    first, second = epochs(), epochs()
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert torch.cat(first).unique().numel() > 0.99 * torch.cat(first).numel()


def test_seed_makes_a_stream_of_its_own() -> None:
    def draws(seed: int) -> Tensor:
        transform = AddNoise(noiseflow.Gaussian(), seed=seed)
        return torch.stack([transform(IMAGE) for _ in range(2)])

    assert torch.equal(draws(1), draws(1))
    assert not torch.equal(draws(1), draws(2))
    assert not torch.equal(*draws(1))


def test_nesting_comes_back_with_the_image_noisy_and_all_else_as_it_was() -> None:
    transform = AddNoise(noiseflow.Gaussian(0.2), seed=0)
    label, mask = "cell", torch.ones(16, 16, dtype=torch.bool)
    found = transform({"image": IMAGE, "rest": [mask, (label, 3)]})
    assert list(found) == ["image", "rest"]
    assert found["rest"][0] is mask
    assert found["rest"][1] == (label, 3)
    assert float((found["image"] - IMAGE).std()) == pytest.approx(0.2, rel=0.2)
    noisy, number = transform(IMAGE, 7)
    assert noisy.shape == IMAGE.shape
    assert number == 7


def test_pairs_of_noisy_and_clean_for_training() -> None:
    (noisy, clean), label = AddNoise(noiseflow.Gaussian(), keep_clean=True)((IMAGE, 1))
    assert clean is IMAGE
    assert label == 1
    assert not torch.equal(noisy, clean)


def test_arrays_and_integers_are_images_too() -> None:
    counts = np.full((16, 16), 100, dtype=np.uint8)
    noisy = AddNoise(noiseflow.Gaussian(5.0))(counts)
    assert isinstance(noisy, np.ndarray)
    assert noisy.dtype.kind == "f"
    assert AddNoise(noiseflow.Gaussian(5.0))(torch.from_numpy(counts)).is_floating_point()


def test_input_without_an_image_is_refused() -> None:
    with pytest.raises(ValueError, match="no image"):
        AddNoise(noiseflow.Gaussian())({"label": 3})


def test_torchvision_images_keep_their_type_and_masks_their_values() -> None:
    tv_tensors = pytest.importorskip("torchvision.tv_tensors")
    image, mask = tv_tensors.Image(IMAGE), tv_tensors.Mask(torch.ones(1, 16, 16))
    first = torch.zeros(3)
    noisy, kept, other = AddNoise(noiseflow.Gaussian())((image, mask, first))
    assert type(noisy) is tv_tensors.Image
    assert kept is mask
    assert other is first
