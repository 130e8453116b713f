"""Denoisers and variance stabilisation."""

import importlib.util

import numpy as np
import pytest
import torch

from noiseflow import Digitised, PoissonGaussian
from recon.denoise import DENOISERS, anscombe, best_strength, estimated_stabiliser, find_denoiser, stabiliser_of
from recon.simulate.noises import SkewedNoise


def blobs(size=64):
    y, x = np.mgrid[:size, :size] / size
    return 0.2 + 0.6 * np.exp(-((x - 0.4) ** 2 + (y - 0.5) ** 2) / 0.03) + 0.2 * (np.hypot(x - 0.6, y - 0.4) < 0.2)


def noisy_stack(noise_model, clean, count=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    signal = torch.from_numpy(clean).float().expand(count, -1, -1)
    with torch.no_grad():
        return noise_model(signal).sample(generator=generator).numpy()


def ramp(low, high, size=400):
    return np.tile(np.linspace(low, high, size), (size, 1))


@pytest.mark.parametrize("name", [name for name in DENOISERS if name != "bm3d"])
@pytest.mark.parametrize("informed", [False, True])
def test_denoisers_at_least_halve_the_error(name, informed):
    noise = SkewedNoise(0.05, 0.1)
    clean = blobs()
    images = noisy_stack(noise, clean)
    denoise = find_denoiser(name, images, noise_model=noise if informed else None)
    result = denoise(images[0])
    assert result.shape == clean.shape
    assert np.mean((result - clean) ** 2) < 0.5 * np.mean((images[0] - clean) ** 2)


def test_bm3d_runs_where_installed_and_says_so_where_not():
    noise = SkewedNoise(0.05, 0.1)
    clean = blobs(32)
    images = noisy_stack(noise, clean)
    if importlib.util.find_spec("bm3d") is None:
        with pytest.raises(ValueError, match="non-commercial"):
            find_denoiser("bm3d", images)(images[0])
    else:
        result = find_denoiser("bm3d", images)(images[0])
        assert np.mean((result - clean) ** 2) < 0.5 * np.mean((images[0] - clean) ** 2)


def test_own_denoiser_by_dotted_name(tmp_path, monkeypatch):
    (tmp_path / "my_denoisers.py").write_text(
        "def double(image):\n    return 2 * image\ndef cut(image):\n    return image[1:]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    images = np.random.default_rng(0).random((2, 8, 8))
    np.testing.assert_allclose(find_denoiser("my_denoisers:double", images)(images[0]), 2 * images[0], rtol=1e-6)
    with pytest.raises(ValueError, match="shape"):
        find_denoiser("my_denoisers:cut", images)(images[0])
    for wrong in ("my_denoisers:none", "no_such_package:f"):
        with pytest.raises(ValueError, match=r"package\.module:function"):
            find_denoiser(wrong, images)
    with pytest.raises(ValueError, match="choose one of nlm"):
        find_denoiser("magic", images)


def test_stronger_noise_asks_for_a_stronger_filter():
    def box(image, strength):
        from scipy.ndimage import gaussian_filter

        return gaussian_filter(image, strength)

    image, noise = blobs(), np.random.default_rng(0).normal(size=(64, 64))
    assert best_strength(box, image + 0.02 * noise) < best_strength(box, image + 0.5 * noise)


@pytest.mark.parametrize(("gain", "offset", "read_noise"), [(1.0, 0.0, 0.5), (2.0, 100.0, 3.0)])
def test_anscombe_makes_the_noise_even_and_comes_back_without_bias(gain, offset, read_noise):
    clean = ramp(offset + 3 * gain, offset + 60 * gain)
    images = noisy_stack(PoissonGaussian(gain, offset, read_noise / gain), clean)
    stabiliser = anscombe(gain, offset, read_noise, images)
    stabilised = stabiliser.forward(images)
    assert stabilised.std((0, 1)) == pytest.approx(1.0, abs=0.15)
    back = stabiliser.inverse(stabilised.mean((0, 1)))
    assert back - clean[0] == pytest.approx(0.0, abs=5 * gain * np.sqrt(60 / 800))
    assert np.mean(back - clean[0]) == pytest.approx(0.0, abs=0.1 * gain)


def test_stabiliser_of_a_clipped_model_undoes_the_bias_of_clipping():
    noise = Digitised(SkewedNoise(0.1, 0.1), step=0.0, low=0.0, high=1.0)
    clean = ramp(0.2, 0.95)
    images = noisy_stack(noise, clean)
    stabiliser = stabiliser_of(noise, images)
    back = stabiliser.inverse(stabiliser.forward(images).mean((0, 1)))
    assert np.abs(images.mean((0, 1)) - clean[0])[-20:].mean() > 0.04
    assert np.abs(np.mean(back - clean[0])) < 0.002
    assert np.abs(np.mean((back - clean[0])[-20:])) < 0.01


def test_estimated_stabiliser_finds_the_line_of_the_variance():
    clean = blobs(256)
    images = noisy_stack(PoissonGaussian(0.01, 0.0, 2.0), clean, count=3)
    stabiliser = estimated_stabiliser(images)
    deviation = (stabiliser.forward(images) - stabiliser.forward(clean)).std()
    assert deviation == pytest.approx(1.0, abs=0.1)
    even = clean + 0.05 * np.random.default_rng(0).normal(size=clean.shape)
    deviation = estimated_stabiliser(even[None]).forward(even) - estimated_stabiliser(even[None]).forward(clean)
    assert deviation.std() == pytest.approx(1.0, abs=0.1)


def test_images_without_noise_are_scaled_only_and_rows_are_too_small():
    dots = np.zeros((2, 40, 40))
    dots[:, 4, 4] = 3.0
    stabiliser = estimated_stabiliser(dots)
    np.testing.assert_allclose(stabiliser.inverse(stabiliser.forward(dots)), dots, atol=1e-9)
    with pytest.raises(ValueError, match="without a denoiser"):
        estimated_stabiliser(np.ones((2, 1, 9)))
