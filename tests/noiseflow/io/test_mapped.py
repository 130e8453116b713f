"""Arrays larger than memory: every format leaves them on the disk, or in a temporary file, and writes them piece by piece."""

import tracemalloc

import numpy as np
import pytest

from noiseflow import io
from noiseflow.io import mapped, ome_zarr
from noiseflow.io.mapped import is_mapped, temporary_map

STACK = np.random.default_rng(0).random((6, 40, 50), dtype=np.float32)


def write_plain_tiff(path):
    io.write(path, STACK)


def write_compressed_tiff(path):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, STACK, photometric="minisblack", compression="zlib")


def write_big_endian_tiff(path):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, STACK, photometric="minisblack", byteorder=">")


def write_hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=STACK.astype(">f4"), chunks=(2, 20, 20), compression="gzip")


def write_zarr(path):
    pytest.importorskip("zarr")
    io.write(path, STACK)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("s.tif", write_plain_tiff),
        ("c.tif", write_compressed_tiff),
        ("b.tif", write_big_endian_tiff),
        ("s.h5", write_hdf5),
        ("s.zarr", write_zarr),
        ("s.mrc", write_plain_tiff),
    ],
)
def test_a_large_stack_stays_out_of_memory(tmp_path, monkeypatch, name, write):
    monkeypatch.setattr(mapped, "IN_MEMORY", 0)
    write(tmp_path / name)
    found = io.read(tmp_path / name, mapped=True).data
    assert is_mapped(found)
    assert found.dtype == np.dtype("f4")
    assert found.dtype.isnative
    np.testing.assert_array_equal(found, STACK)
    found[0] = 0  # which changes no file
    np.testing.assert_array_equal(io.read(tmp_path / name).data, STACK)


def test_ome_zarr_carries_its_name(tmp_path):
    zarr = pytest.importorskip("zarr")
    io.write(tmp_path / "needle.ome.zarr", STACK)
    assert zarr.open(tmp_path / "needle.ome.zarr", mode="r").attrs["ome"]["multiscales"][0]["name"] == "needle"


def test_ome_zarr_is_written_piece_by_piece(tmp_path, monkeypatch):
    pytest.importorskip("zarr")
    monkeypatch.setattr(ome_zarr, "_CHUNK", 32)
    volume = temporary_map((131, 128, 129), np.float32)
    for number, section in enumerate(volume):
        section[...] = number
    io.write(tmp_path / "warm.zarr", STACK)  # imports count the first time
    tracemalloc.start()
    try:
        io.write(tmp_path / "v.zarr", volume)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < volume.nbytes  # float64 copies of the whole take three times as much
    import zarr

    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    np.testing.assert_array_equal(group["0"][:], volume)
    assert group["1"].shape == (65, 64, 64)
    np.testing.assert_array_equal(group["1"][:, 0, 0], np.arange(65) * 2 + 0.5)
