"""The napari plugin without a viewer: manifest, reader, writer, and the widget under an offscreen Qt."""

import inspect
import re
import time
from dataclasses import fields

import numpy as np
import pytest

from noiseflow import io
from noiseflow.installation import DISTRIBUTION
from noiseflow.io.mapped import is_mapped
from recon.commands.options import ReconstructOptions
from recon.names import FIELDS
from recon.napari import get_reader, write_image
from recon.napari.plugin import reconstruct_layers


@pytest.fixture
def needle(data, tmp_path):
    """A few rows of the shipped needle, as a layer."""
    whole = io.read(data / "tilt_needle" / "needle_aligned.mrc")
    path = tmp_path / "needle.mrc"
    io.write(path, whole.data[::6, 28:34], voxel_size=whole.voxel_size)
    angles = io.read_tilts(data / "tilt_needle" / "needle_aligned.rawtlt").angles[::6]
    path.with_suffix(".rawtlt").write_text("\n".join(map(str, angles)))
    return path


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_manifest_is_valid_and_its_functions_exist():
    npe2 = pytest.importorskip("npe2", reason="needs the extra [napari]")
    manifest = npe2.PluginManifest.from_distribution(DISTRIBUTION)
    manifest.validate_imports()
    (reader,), (writer,) = manifest.contributions.readers, manifest.contributions.writers
    assert set(reader.filename_patterns) == {f"*{suffix}" for suffix in io.SUFFIXES}
    assert set(writer.filename_extensions) <= io.SUFFIXES
    assert {command.python_name.split(":")[1] for command in manifest.contributions.commands} == {
        "get_reader",
        "write_image",
        "reconstruct_widget",
    }


def test_reader_gives_pixels_angles_and_scale(needle):
    (pixels, attributes, kind), *rest = get_reader(str(needle))(str(needle))
    assert not rest
    assert kind == "image"
    assert len(attributes["metadata"]["tilt_angles"]) == len(pixels)
    pixel = attributes["metadata"]["voxel_size"][2]
    assert attributes["scale"] == pytest.approx((1.0, pixel, pixel))
    assert attributes["units"] == ("angstrom",) * 3  # as those of the volume, or napari uses neither
    assert attributes["axis_labels"] == ("tilt", "y", "x")


def test_reader_declines_what_is_not_its_own():
    assert get_reader("notes.txt") is None
    assert get_reader(["a.mrc", "b.mrc"]) is None


def test_written_volume_comes_back_with_its_voxel_size(tmp_path):
    path, volume = str(tmp_path / "volume.mrc"), np.random.default_rng(0).random((4, 5, 6), dtype=np.float32)
    assert write_image(path, volume, {"metadata": {"voxel_size": (7.0, 7.0, 7.0)}}) == [path]
    ((pixels, attributes, _),) = get_reader(path)(path)
    np.testing.assert_array_equal(pixels, volume)
    assert attributes["scale"] == pytest.approx((7.0, 7.0, 7.0))
    assert attributes["units"] == ("angstrom",) * 3


def test_layer_is_reconstructed_with_progress(needle):
    ((pixels, attributes, _),) = get_reader(str(needle))(str(needle))
    steps = []
    ((volume, result, _),) = reconstruct_layers(
        pixels,
        attributes["metadata"],
        method="tv",
        thickness=16,
        num_steps=8,
        progress=lambda task, done, total, note: steps.append((done, total)),
    )
    assert volume.shape == (16, 6, 64)
    assert result["scale"] == pytest.approx((attributes["metadata"]["voxel_size"][-1],) * 3)
    assert result["axis_labels"] == ("z", "y", "x")
    assert re.search("good|doubtful|bad", result["metadata"]["verdict"][0])
    assert steps[-1][0] == steps[-1][1]
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_error_bars_come_as_hidden_layers_from_the_widget_and_from_files(needle, tmp_path):
    ((pixels, attributes, _),) = get_reader(str(needle))(str(needle))
    options = {"mode": "linear", "method": "tv", "thickness": 16, "num_steps": 4, "uncertainty": 2}
    volume, *bars = reconstruct_layers(pixels, attributes["metadata"], **options)
    assert [look["name"] for _, look, _ in bars] == ["standard deviation", "bias", "missing wedge"]
    assert all(values.shape == volume[0].shape and not look["visible"] for values, look, _ in bars)
    assert bars[0][0].min() >= 0 < bars[0][0].max()
    path = tmp_path / "volume.mrc"
    for name, values in (("volume", volume[0]), ("volume_std", bars[0][0]), ("volume_bias", bars[1][0])):
        io.write(tmp_path / f"{name}.mrc", values)
    read = get_reader(str(path))(str(path))
    assert [look["name"] for _, look, _ in read] == ["volume", "volume_std", "volume_bias"]
    np.testing.assert_array_equal(read[1][0], bars[0][0])
    low, high = read[2][1]["contrast_limits"]
    assert low == -high


def test_a_large_file_stays_on_the_disk_until_it_is_looked_at(needle, monkeypatch):
    assert not is_mapped(get_reader(str(needle))(str(needle))[0][0])
    monkeypatch.setattr("noiseflow.io.mapped.IN_MEMORY", 0)
    assert is_mapped(get_reader(str(needle))(str(needle))[0][0])


def test_layer_without_angles_is_refused_with_the_fix():
    with pytest.raises(ValueError, match="angle file"):
        reconstruct_layers(np.zeros((3, 4, 4)), {})


def test_layers_are_reconstructed_with_the_defaults_of_the_command():
    options = {each.name: each.default for each in fields(ReconstructOptions)}
    names = {"num_steps": "steps", "field": "field"}
    for name, parameter in inspect.signature(reconstruct_layers).parameters.items():
        if parameter.default is not inspect.Parameter.empty and name != "progress":
            default = options[names.get(name, name)]
            assert parameter.default == (default or parameter.default), name
            assert default is not None or parameter.default in (None, 0, FIELDS.first), name


@pytest.mark.slow
def test_widget_adds_the_volume_to_the_viewer(needle, tmp_path, monkeypatch):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    npe2 = pytest.importorskip("npe2", reason="needs the extra [napari]")
    pytest.importorskip("napari", reason="needs the extra [napari]")
    pytest.importorskip("PyQt6", reason="needs a Qt binding")
    from napari.components import ViewerModel
    from napari.utils import progress
    from qtpy.QtWidgets import QApplication

    from recon.napari import reconstruct_widget

    application = QApplication.instance() or QApplication([])
    npe2.PluginManager.instance().discover()
    viewer = ViewerModel()
    (layer,) = viewer.open(str(needle), plugin=DISTRIBUTION)
    form = reconstruct_widget()
    settings = inspect.signature(reconstruct_layers).parameters
    assert all(
        getattr(form, name).value == settings[name].default for name in ("mode", "method", "field", "uncertainty")
    )
    form.tilts.choices = [layer]
    chosen = {"method": "l2", "field": "gaussians", "thickness": 16, "num_steps": 8}
    percents = []
    monkeypatch.setattr(progress, "increment_with_overflow", lambda self: percents.append(self.total))
    form(viewer=viewer, tilts=layer, **chosen)
    deadline = time.monotonic() + 120
    while len(viewer.layers) < 2 and time.monotonic() < deadline:
        application.processEvents()
        time.sleep(0.02)
    volume = viewer.layers[1]
    assert volume.data.shape == (16, 6, 64)
    assert percents == [100] * 100  # the bar ends with the fit
    ((same, *_),) = reconstruct_layers(layer.data, layer.metadata, **chosen)
    ((grids, *_),) = reconstruct_layers(layer.data, layer.metadata, **chosen | {"field": FIELDS.first})
    np.testing.assert_allclose(volume.data, same, atol=1e-3 * same.max())
    assert np.abs(grids - same).max() > 0.05 * same.max()
    assert not layer.visible
    assert viewer.text_overlay.text.startswith("verdict")
    assert round(viewer.dims.point[0] / volume.scale[0]) == 8
    (written,) = volume.save(str(tmp_path / "volume.mrc"), plugin=DISTRIBUTION)
    np.testing.assert_array_equal(io.read(written).data, volume.data)
