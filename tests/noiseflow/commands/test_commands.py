"""The commands as a user runs them: results, reproducibility, and one clear line for each mistake."""

from pathlib import Path

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import io


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return noiseflow.save(noiseflow.Gaussian(0.1), tmp_path / "model.safetensors")


@pytest.fixture
def clean(tmp_path: Path) -> Path:
    path = tmp_path / "clean.mrc"
    io.write(path, np.linspace(0, 1, 4096, dtype=np.float32).reshape(64, 64), voxel_size=(1.0, 2.0, 2.0))
    return path


def test_sample_is_reproducible_and_noisy(run, model: Path, clean: Path, tmp_path: Path) -> None:
    noisy = [tmp_path / f"noisy{i}.mrc" for i in range(3)]
    for path, seed in zip(noisy, ("7", "7", "8"), strict=True):
        run("sample", model, clean, "-o", path, "--seed", seed)
    first, again, other = (io.read(path) for path in noisy)
    assert np.array_equal(first.data, again.data)
    assert not np.array_equal(first.data, other.data)
    assert (first.data - io.read(clean).data).std() == pytest.approx(0.1, rel=0.05)
    assert first.voxel_size == pytest.approx((1, 2, 2))


def test_evaluate_with_baselines(run, model: Path, clean: Path, tmp_path: Path) -> None:
    noisy = tmp_path / "noisy.tif"
    run("sample", model, clean, "-o", noisy)
    result = run("evaluate", model, "--signal", clean, "--observation", noisy, "--baselines")
    assert result["models"]["model"]["nll"] == pytest.approx(0.5 * np.log(2 * np.pi * np.e * 0.01), abs=0.1)
    assert set(result["models"]) == {"model", "Gaussian", "Poisson"}
    assert result["spatial"][0]["suffices"]
    assert not result["notes"]


def test_evaluate_takes_whole_images_for_a_camera(run, refused, clean: Path, tmp_path: Path) -> None:
    gain = 1 + 0.2 * torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    camera, noisy = saved(noiseflow.WithMaps(noiseflow.Gaussian(0.1), gain), tmp_path), tmp_path / "noisy.tif"
    run("sample", camera, clean, "-o", noisy)
    result = run("evaluate", camera, "--signal", clean, "--observation", noisy, "--baselines")
    found = result["models"]["model"]
    assert found["ks"] < 1.2 * found["ks_floor"]
    assert result["num_pixels"] == found["num_pixels"] == result["models"]["Poisson"]["num_pixels"]
    assert found["nll"] < result["models"]["Gaussian"]["nll"] - 0.05
    assert "normal scores" in result["notes"][-1]
    half, half_noisy = tmp_path / "half.npy", tmp_path / "half_noisy.npy"
    np.save(half, io.read(clean).data[:32])
    np.save(half_noisy, io.read(noisy).data[:32])
    pairs = ["--signal", clean, "--observation", noisy, "--signal", half, "--observation", half_noisy]
    assert "one size" in refused("evaluate", camera, *pairs)
    assert "maps (64, 64)" in refused("evaluate", camera, "--signal", half, "--observation", half_noisy)


def test_commands_tell_how_many_pixels_a_model_does_not_describe(run, clean: Path, tmp_path: Path) -> None:
    signal = torch.linspace(0, 0.5, 5000)
    observation = signal + 0.1 * torch.randn(5000, generator=torch.Generator().manual_seed(0))
    model = saved(noiseflow.fit(noiseflow.Gaussian(), signal, observation).noise_model, tmp_path)
    noisy = tmp_path / "noisy.npy"
    assert run("sample", model, clean, "-o", noisy)["notes"][0].startswith("2048 of 4096")
    image = np.load(noisy)
    image[:, :3] = 5.0
    np.save(noisy, image)
    notes = run("evaluate", model, "--signal", clean, "--observation", noisy)["notes"]
    assert [note.split(" 4096")[0] + " 4096" for note in notes] == ["2048 of 4096", "192 of 4096"]


@pytest.mark.parametrize("bad", ["missing", "empty", "nan", "truncated", "not a model", "folder", "wrong suffix"])
def test_mistakes_are_one_line_and_leave_nothing(refused, bad: str, model: Path, clean: Path, tmp_path: Path) -> None:
    image, output = clean, tmp_path / "out" / "noisy.mrc"
    output.parent.mkdir()
    if bad == "missing":
        image = tmp_path / "none.mrc"
    elif bad == "empty":
        image.write_bytes(b"")
    elif bad == "nan":
        io.write(image, np.full((4, 4), np.nan, np.float32))
    elif bad == "truncated":
        image.write_bytes(image.read_bytes()[:2000])
    elif bad == "not a model":
        model = clean
    elif bad == "folder":
        image = tmp_path
    else:
        output = tmp_path / "out" / "noisy.jpg"
    refused("sample", model, image, "-o", output)
    assert not list((tmp_path / "out").iterdir())


def test_evaluate_refuses_unequal_pairs(refused, model: Path, clean: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.npy"
    io.write(other, np.zeros((3, 3)))
    assert "must have one shape" in refused("evaluate", model, "--signal", clean, "--observation", other)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_missing_gpu_is_explained(refused, model: Path, clean: Path, tmp_path: Path) -> None:
    message = refused("sample", model, clean, "-o", tmp_path / "n.mrc", "--device", "cuda")
    assert "--device cpu" in message


def saved(model: torch.nn.Module, folder: Path, **options: str) -> Path:
    return noiseflow.save(model, folder / "own.safetensors", **options)


def test_sample_keeps_the_number_type_where_it_holds_the_noise(run, tmp_path: Path) -> None:
    clean, noisy = tmp_path / "clean.npy", tmp_path / "noisy.npy"
    np.save(clean, np.full((20, 30), 100, np.uint8))
    camera = noiseflow.Digitised(noiseflow.Gaussian(5.0), 1.0, 0.0, 255.0)
    run("sample", saved(camera, tmp_path), clean, "-o", noisy)
    assert np.load(noisy).dtype == np.uint8
    run("sample", saved(noiseflow.Gaussian(5.0), tmp_path), clean, "-o", noisy)
    assert np.load(noisy).dtype == np.float32
    run("sample", saved(noiseflow.Gaussian(5.0), tmp_path), clean, "-o", noisy, "--dtype", "float64")
    assert np.load(noisy).dtype == np.float64


def test_sample_writes_the_integers_of_a_model_that_rounds(run, tmp_path: Path) -> None:
    clean, noisy = tmp_path / "clean.npy", tmp_path / "noisy.npy"
    for level, step, kind in (
        (300.0, 1.0, np.uint16),
        (0.0, 2.0, np.int16),
        (1e5, 1.0, np.int32),
        (9.0, 0.5, np.float32),
    ):
        np.save(clean, np.full((20, 30), level, np.float32))
        run("sample", saved(noiseflow.Digitised(noiseflow.Gaussian(5.0), step), tmp_path), clean, "-o", noisy)
        assert np.load(noisy).dtype == kind


def test_sample_refuses_a_number_type_that_cannot_hold_the_noise(refused, tmp_path: Path) -> None:
    np.save(tmp_path / "clean.npy", np.full((20, 30), 100, np.uint8))
    words = ("sample", saved(noiseflow.Gaussian(5.0), tmp_path), tmp_path / "clean.npy", "-o", tmp_path / "n.npy")
    assert "not whole numbers" in refused(*words, "--dtype", "uint8")
    assert "choose auto" in refused(*words, "--dtype", "uint7")


def test_sample_takes_arrays_of_four_axes(run, tmp_path: Path) -> None:
    clean, noisy = tmp_path / "clean.npy", tmp_path / "noisy.npy"
    np.save(clean, np.full((2, 3, 20, 30), 0.5, np.float32))
    run("sample", saved(noiseflow.ScanNoise(noiseflow.Gaussian(0.1), 0.2), tmp_path), clean, "-o", noisy)
    found = np.load(noisy)
    assert found.shape == (2, 3, 20, 30)
    assert found.mean(-1).std() == pytest.approx(0.2, rel=0.3)


def test_sample_says_that_clean_pixels_lie_beyond_clipping(run, tmp_path: Path) -> None:
    np.save(tmp_path / "clean.npy", np.full((20, 30), 300.0, np.float32))
    camera = noiseflow.Digitised(noiseflow.Gaussian(0.1), 0.0, 0.0, 1.0)
    result = run(
        "sample", saved(camera, tmp_path, units="transmission"), tmp_path / "clean.npy", "-o", tmp_path / "n.npy"
    )
    (note,) = result["notes"]
    assert "100% of the clean pixels lie beyond the clipping limit 1" in note
    assert "transmission" in note


def test_example_data_is_copied_whole_and_replaces_nothing(tmp_path, run, refused, data):
    copied = run("demo", "--files-only", "--out", tmp_path / "examples")["files"]
    wanted = {path.relative_to(data): path.read_bytes() for path in data.rglob("*") if path.is_file()}
    assert {Path(path).relative_to(tmp_path / "examples"): Path(path).read_bytes() for path in copied} == wanted
    assert "--overwrite" in refused("demo", "--files-only", "--out", tmp_path / "examples")
    run("demo", "--files-only", "--out", tmp_path / "examples", "--overwrite")
