"""The example of a reconstructor of one's own: blind to each pixel, and it denoises real data."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from noiseflow.io import read_image


def test_no_pixel_is_predicted_from_itself(example: ModuleType) -> None:
    image = torch.rand(11, 12, generator=torch.Generator().manual_seed(0))
    network = example.BlindSpotNetwork(image, channels=4)
    torch.nn.init.normal_(network.last.weight)
    network.image.requires_grad_()
    for pixel in (0, 1, 11, 12, 13, 70, 119, 131):
        network.image.grad = None
        network(torch.tensor([pixel])).sum().backward()
        gradient = network.image.grad.reshape(-1)
        assert float(gradient[pixel]) == 0
        assert int((gradient != 0).sum()) > 8


def test_real_exposure_is_denoised(example: ModuleType, data: Path) -> None:
    folder = data / "exposures_miro"
    noisy, reference = (
        example.middle(read_image(folder / f"channel1_{name}.tif").astype(np.float64), 64) for name in ("050ms", "long")
    )
    denoised, noise_model, result = example.denoise(torch.from_numpy(noisy).float(), num_steps=60)
    assert example.psnr(denoised.double().numpy(), reference) > example.psnr(noisy, reference) + 4
    assert result.held_out_nll <= min(result.history.values())
    dim, bright = noise_model(torch.quantile(denoised, torch.tensor([0.1, 0.9]))).variance.sqrt().tolist()
    assert bright > dim


def test_the_script_prints_psnr_and_saves_its_picture(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "picture.png"
    monkeypatch.setattr(sys, "argv", ["own_reconstructor.py", "--size", "40", "--steps", "10", "--out", str(picture)])
    example.main()
    assert capsys.readouterr().out.count(" dB") == 2
    assert picture.stat().st_size > 10_000
