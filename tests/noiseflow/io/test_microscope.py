"""The microscopes' own formats, HDF5 and OME-Zarr (extra ``[formats]``)."""

import importlib
import json
import struct
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from noiseflow import io
from tests.test_formats import ANGLES, PIXEL, images, velox_emd

STACK = np.arange(60, dtype=np.uint16).reshape(3, 4, 5)
NEEDLE = Path(__file__).parents[4] / "shared" / "data" / "tilt_needle" / "needle_raw.dm3"
TOOTH = Path(__file__).parents[4] / "shared" / "data" / "flatdark_tooth" / "tooth.h5"


def axes(units: list[str], scales: list[float], offsets: list[float]) -> list[dict]:
    names, rows = "zyx"[-len(units) :], zip(units, scales, offsets, STACK.shape, strict=False)
    return [
        {"name": name, "units": u, "scale": s, "offset": o, "size": n, "index_in_array": i, "navigate": False}
        for i, (name, (u, s, o, n)) in enumerate(zip(names, rows, strict=True))
    ]


def signal(data: np.ndarray, **more) -> dict:
    metadata = {"General": {"title": "HAADF"}, "Signal": {"signal_type": ""}}
    return {
        "data": data,
        "metadata": metadata,
        "original_metadata": {},
        "attributes": {"_lazy": False},
        "package": "",
        "package_info": {"name": "", "version": ""},
        "tmp_parameters": {},
        "learning_results": {},
        "models": {},
    } | more


def write_ser(path: Path, image: np.ndarray, pixel_size: float) -> None:
    """One image in TIA's series format, as its description says."""
    array_offset = 30 + 32
    head = struct.pack("<2sHHIIIIII", b"II", 0x0197, 0x0210, 0x4122, 0x4152, 1, 1, array_offset, 1)
    dimension = struct.pack("<IddIII", 1, 0.0, 1.0, 0, 0, 0)
    data_offset = array_offset + 8
    element = struct.pack("<ddIddIHII", 0, pixel_size, 0, 0, pixel_size, 0, 2, *image.shape[::-1])
    tag_offset = data_offset + len(element) + image.nbytes
    offsets = struct.pack("<II", data_offset, tag_offset)
    path.write_bytes(head + dimension + offsets + element + image.tobytes() + struct.pack("<II", 0x4152, 0))


@pytest.mark.skipif(not NEEDLE.exists(), reason="the raw needle series is not here")
def test_raw_dm3_series() -> None:
    image = io.read(NEEDLE)
    assert image.data.shape == (91, 64, 64)
    assert image.data.dtype == np.uint16
    np.testing.assert_allclose(image.tilt_angles, np.arange(-90, 91, 2))
    assert image.voxel_size == pytest.approx((179.949,) * 3, rel=1e-5)
    assert repr(image) == "ImageFile(91 x 64 x 64 uint16, voxel size 179.95 x 179.95 x 179.95 Å, tilts -90° to 90°)"


@pytest.mark.skipif(not TOOTH.exists(), reason="the tooth is not here")
def test_data_exchange_hdf5() -> None:
    image = io.read(TOOTH)
    assert image.data.shape == (181, 2, 640)
    np.testing.assert_allclose(image.tilt_angles, np.linspace(0, 179, 181), atol=1)
    assert io.read(f"{TOOTH}::/exchange/data_dark").data.shape == (10, 2, 640)
    with pytest.raises(ValueError, match="holds no '/none'; available: '/exchange/data'"):
        io.read(f"{TOOTH}::/none")


def test_hspy_series_with_degrees_on_its_axis(tmp_path: Path) -> None:
    from rsciio.hspy import file_writer

    found = axes(["deg", "nm", "nm"], [2.0, 0.5, 0.25], [-2.0, 0, 0])
    file_writer(str(tmp_path / "a.hspy"), signal(STACK, axes=found))
    image = io.read(tmp_path / "a.hspy")
    np.testing.assert_array_equal(image.data, STACK)
    np.testing.assert_allclose(image.tilt_angles, [-2, 0, 2])
    assert image.voxel_size == pytest.approx((2.5, 5.0, 2.5))


def test_emd_volume(tmp_path: Path) -> None:
    from rsciio.emd import file_writer

    file_writer(str(tmp_path / "a.emd"), signal(STACK, axes=axes(["nm"] * 3, [0.3, 0.2, 0.1], [0.0] * 3)))
    image = io.read(tmp_path / "a.emd")
    np.testing.assert_array_equal(image.data, STACK)
    assert image.voxel_size == pytest.approx((3, 2, 1))
    assert image.tilt_angles is None


def test_ser_image(tmp_path: Path) -> None:
    write_ser(tmp_path / "a_1.ser", STACK[0], 2e-10)
    image = io.read(tmp_path / "a_1.ser")
    np.testing.assert_array_equal(image.data, STACK[0][::-1])  # TIA counts rows from the bottom
    assert image.voxel_size == pytest.approx((2, 2, 2))


def test_several_equal_images_ask_for_a_name(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["entry/haadf"], file["entry/bf"] = STACK, STACK + 1
        file["entry/tilt_angle"] = np.deg2rad([-30.0, 0, 30])
        file["entry/tilt_angle"].attrs["units"] = "rad"
        file["entry/bf"].attrs["element_size_um"] = [3e-4, 2e-4, 1e-4]
    with pytest.raises(ValueError, match=r"several images: '/entry/bf', '/entry/haadf'; name one as FILE::NAME"):
        io.read(tmp_path / "a.h5")
    image = io.read(f"{tmp_path / 'a.h5'}::/entry/bf")
    np.testing.assert_array_equal(image.data, STACK + 1)
    np.testing.assert_allclose(image.tilt_angles, [-30, 0, 30])
    assert image.voxel_size == pytest.approx((3, 2, 1))


@pytest.mark.parametrize("suffix", [".h5", ".emd"])
def test_uneven_angles_are_those_of_their_own_images(tmp_path: Path, suffix: str) -> None:
    """Of two groups, whose doses and times look like angles, too."""
    told = {"series1": [-40.0, 0, 30], "series2": [-30.0, -10, 40]}
    with h5py.File(tmp_path / f"tilts{suffix}", "w") as file:
        file.attrs.update(version_major=0, version_minor=2)
        for name, angles in told.items():
            group = file.create_group(f"tilts/{name}")
            group.attrs["emd_group_type"] = 1
            group["data"], group["dose"] = STACK, [0.0, 10, 20]
            lists = {"tilt": angles, "y": np.arange(STACK.shape[1]), "x": np.arange(STACK.shape[2])}
            for axis, (word, values) in enumerate(lists.items(), 1):
                group[f"dim{axis}"] = values
                group[f"dim{axis}"].attrs.update(name=word, units="[deg]" if axis == 1 else "[n_m]")
    for name, angles in told.items():
        member = name if suffix == ".emd" else f"/tilts/{name}/data"
        np.testing.assert_allclose(io.read(tmp_path / f"tilts{suffix}", channel=member).tilt_angles, angles)


@pytest.mark.parametrize(
    ("lost", "stated"), [("chunks", True), ("Scan", True), ("Version", True), ("Metadata", False)], ids=str
)
def test_velox_images_that_lost_parts_of_their_file_are_read(tmp_path: Path, lost: str, stated: bool) -> None:
    path, group = velox_emd(tmp_path), "Data/Image/0123456789abcdef0123456789abcdef"
    with h5py.File(path, "r+") as file:
        texts = np.asarray(file[f"{group}/Metadata"])
        if lost == "chunks":
            pixels = np.asarray(file[f"{group}/Data"])
            del file[f"{group}/Data"]
            file[f"{group}/Data"] = pixels
        elif lost == "Scan":
            frames = [json.loads(column.tobytes().partition(b"\0")[0]) for column in texts.T]
            kept = ({name: frame[name] for name in ("BinaryResult", "Stage")} for frame in frames)
            del file[f"{group}/Metadata"]
            columns = [np.frombuffer(json.dumps(each).encode().ljust(4000, b"\0"), "u1") for each in kept]
            file[f"{group}/Metadata"] = np.stack(columns, axis=1)
        else:
            del file[lost if lost in file else f"{group}/{lost}"]
    with pytest.warns(UserWarning, match="metadata"):
        image = io.read(path)
    np.testing.assert_array_equal(image.data, images().astype("u2"))
    if stated:
        np.testing.assert_allclose(image.tilt_angles, ANGLES)
        assert image.voxel_size == pytest.approx((PIXEL, PIXEL, PIXEL))
    else:
        assert image.tilt_angles is None
        assert image.voxel_size is None


def test_hdf5_claims_without_pixels_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(
            "data", shape=(10_000, 10_000, 10_000), dtype="f4", chunks=(1, 100, 100), compression="gzip"
        )
    with pytest.raises(ValueError, match="claims 4000000000000 bytes"):
        io.read(tmp_path / "a.h5")


@pytest.mark.parametrize("suffix", [".dm3", ".dm4", ".emd", ".ser", ".emi", ".hspy", ".h5", ".nxs"])
def test_damaged_files_of_every_format_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    for content in (b"x", b"not a microscope's file at all" * 50, bytes(4096), b"\x89HDF\r\n\x1a\n" + bytes(3000)):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot be read|holds no"):
            io.read(path)


@pytest.mark.parametrize(
    ("name", "module"), [("a.dm3", "rsciio.digitalmicrograph"), ("a.h5", "h5py"), ("a.zarr", "zarr")]
)
def test_missing_extra_is_named_with_its_pip_line(tmp_path: Path, name: str, module: str, monkeypatch) -> None:
    path = tmp_path / name
    path.mkdir() if path.suffix == ".zarr" else path.write_bytes(b"x" * 99)
    for loaded in [m for m in sys.modules if m == module or m.startswith(f"{module}.")]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install '.*\[formats\]'"):
        io.read(path)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4", "f8"])
@pytest.mark.parametrize("shape", [(70, 130), (3, 70, 65), (1, 5, 5)])
def test_ome_zarr_is_exact_at_full_size_and_halves_from_there(tmp_path: Path, dtype: str, shape: tuple) -> None:
    data = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    path = tmp_path / "volume.ome.zarr"
    io.write(path, data, voxel_size=(4.0, 3.0, 2.0))
    io.write(path, data, voxel_size=(4.0, 3.0, 2.0))
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    image = io.read(path)
    assert image.data.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(np.squeeze(image.data), np.squeeze(data))
    assert image.voxel_size[1:] == (3.0, 2.0)
    ome = json.loads((path / "zarr.json").read_text())["attributes"]["ome"]
    (multiscale,) = ome["multiscales"]
    assert ome["version"] == "0.5"
    assert {axis["unit"] for axis in multiscale["axes"]} == {"angstrom"}
    levels = [io.read(path).data.shape] if max(shape) <= 64 else multiscale["datasets"]
    assert len(levels) == 1 + max(0, int(np.ceil(np.log2(max(shape) / 64))))


def test_ome_zarr_levels_keep_the_mean_and_the_place(tmp_path: Path) -> None:
    zarr = importlib.import_module("zarr")
    data = np.random.default_rng(0).random((128, 128)).astype(np.float32)
    io.write(tmp_path / "a.zarr", data, voxel_size=(1.0, 1.0, 1.0))
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    assert group["1"][:].shape == (64, 64)
    np.testing.assert_allclose(group["1"][3, 5], data[6:8, 10:12].mean(), rtol=1e-6)
    transforms = group.attrs["ome"]["multiscales"][0]["datasets"][1]["coordinateTransformations"]
    assert [t.get("scale", t.get("translation")) for t in transforms] == [[2, 2], [0.5, 0.5]]
    assert group["1"].metadata.dimension_names == ("y", "x")


def test_failed_zarr_leaves_the_old_one(tmp_path: Path) -> None:
    io.write(tmp_path / "a.zarr", STACK)
    with pytest.raises(ValueError, match="not real-valued"):
        io.write(tmp_path / "a.zarr", np.array([[object()]]))
    np.testing.assert_array_equal(io.read(tmp_path / "a.zarr").data, STACK)
    assert len(list(tmp_path.iterdir())) == 1
