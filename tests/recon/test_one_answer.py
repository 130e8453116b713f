"""Command line, Python and napari are three doors to one program."""

import numpy as np
import pytest

import recon
from noiseflow import io
from recon.napari import get_reader
from recon.napari.plugin import reconstruct_layers
from tests.commands import run_command


@pytest.fixture
def needle(data, tmp_path):
    """A few rows of the shipped needle, tilts out of order, one of them spoilt."""
    whole = io.read(data / "tilt_needle" / "needle_aligned.mrc")
    angles = np.array(io.read_tilts(data / "tilt_needle" / "needle_aligned.rawtlt").angles)
    some = np.random.default_rng(0).permutation(np.arange(0, len(angles), 4))
    images = whole.data[some, 26:38].copy()
    images[3] = images[3, ::-1, ::-1]
    path = tmp_path / "needle.mrc"
    io.write(path, images, voxel_size=whole.voxel_size)
    path.with_suffix(".rawtlt").write_text("\n".join(map(str, angles[some])))
    return path


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("method", ["joint", "sirt"])
def test_command_python_and_napari_give_the_same_volume_to_the_last_bit(needle, tmp_path, method):
    steps = {"num_steps": 6} if method == "joint" else {}
    options = ["--steps", "6"] if steps else []
    run_command("reconstruct", needle, "-o", tmp_path / "volume.mrc", "--mode", "linear", "--method", method, *options)
    by_command = io.read(tmp_path / "volume.mrc").data

    series = recon.read_tilt_series(needle, mode="linear")
    by_python = recon.reconstruct(recon.prepare(series).tilt_series, method=method, **steps).volume.attenuation

    ((pixels, attributes, _),) = get_reader(str(needle))(str(needle))
    ((by_napari, _, _),) = reconstruct_layers(pixels, attributes["metadata"], mode="linear", method=method, **steps)

    np.testing.assert_array_equal(by_command, by_python)
    np.testing.assert_array_equal(by_command, by_napari)
