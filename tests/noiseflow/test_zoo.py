"""The shipped noise models of real detectors."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import zoo
from noiseflow.metrics.evaluation import num_outside

ROOT = Path(__file__).parents[2]


def test_zoo_holds_the_four_detectors() -> None:
    assert zoo.names() == ["miro-scmos", "needle-haadf", "tooth-xray", "zhuang-scmos"]
    with pytest.raises(ValueError, match="miro-scmos"):
        zoo.load("no-such-camera")


@pytest.mark.parametrize("name", zoo.names())
def test_model_samples_with_the_statistics_of_its_data(name: str) -> None:
    model, about = zoo.load(name), zoo.describe(name)
    assert about["units"] == "counts"
    assert all(about[name] for name in ("source", "fitted_to", "deviations"))
    assert (ROOT / "docs" / "zoo" / f"{name}.md").is_file()
    generator = torch.Generator().manual_seed(0)
    apart, side = [], 24 if name == "tooth-xray" else 256
    for row in about["statistics"]:
        signal = torch.full((side, side), row["signal"])
        with torch.no_grad():
            sample = model(signal).sample(generator=generator)
            if name == "zhuang-scmos":  # the data are differences of successive frames
                sample = signal + (model(signal).sample(generator=generator) - sample) / 2**0.5
        residual = (sample - signal).double()
        error = row["deviation"] / np.sqrt(row["count"])
        assert (
            abs(float(residual.mean()) - row["mean"])
            < 0.06 * row["deviation"] + 4 * error + 5 * row["deviation"] / side
        )
        apart.append(abs(float(residual.std()) / row["deviation"] - 1))
    # one read noise for all pixels of tooth-xray; pixels of zhuang-scmos are here mixed over all signals
    most, usual = {
        "miro-scmos": (0.045, 0.025),
        "needle-haadf": (0.035, 0.012),
        "tooth-xray": (0.22, 0.08),
        "zhuang-scmos": (0.25, 0.095),
    }[name]
    assert max(apart) < most
    assert np.median(apart) < usual


@pytest.mark.parametrize("name", zoo.names())
def test_pixels_outside_the_signals_of_the_data_are_counted(name: str) -> None:
    model = zoo.load(name)
    signal = torch.cat([torch.full((50,), row["signal"]) for row in zoo.describe(name)["statistics"]])
    assert num_outside(model, signal) == 0
    assert num_outside(model, signal + 1e6) == signal.numel()


def test_shipped_frames_have_the_noise_of_their_camera() -> None:
    frames = noiseflow.io.read(
        Path(noiseflow.__file__).parent / "data" / "exposures_zhuang" / "frames.tif"
    ).data.astype(float)
    mean = frames.mean(0)
    dim = torch.from_numpy(mean < np.quantile(mean, 0.6))
    camera = zoo.load("zhuang-scmos")
    signal = ((torch.from_numpy(mean).float() - camera.offset) / camera.gain).clamp(min=0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        first, second = (camera(signal).sample(generator=generator)[dim].double() for _ in range(2))
    measured = np.diff(frames, axis=0)[:, dim.numpy()].var()
    assert measured == pytest.approx(float((second - first).var()), rel=0.08)


def test_files_are_no_pickles_and_carry_licences() -> None:
    for name in zoo.names():
        path = zoo.FOLDER / f"{name}.safetensors"
        assert not zipfile.is_zipfile(path)
        assert path.stat().st_size < 1e6
        assert f"--- {name} ---" in (zoo.FOLDER / "LICENSE").read_text(encoding="utf-8")
