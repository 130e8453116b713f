"""What this program wrote it knows again; what others wrote it does not replace unasked."""

from __future__ import annotations

import os

import mrcfile
import numpy as np
import pytest
import tifffile

import noiseflow
from noiseflow import io
from noiseflow.report import Report
from noiseflow.runs.outputs import Outputs
from noiseflow.runs.ownership import is_own
from recon.series.files import write_angles

IMAGE = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
OWN = ["a.mrc", "a.rec", "a.tif", "a.npy", "a.zarr"]


def foreign(path):
    """An image as other programs write it."""
    if path.suffix in (".mrc", ".rec"):
        with mrcfile.new(path) as file:
            file.set_data(IMAGE)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, IMAGE, photometric="minisblack")
    elif path.suffix == ".npy":
        np.save(path, IMAGE)
    elif path.suffix == ".zarr":
        path.mkdir()
        (path / "zarr.json").write_text('{"attributes": {"_creator": {"name": "another"}}}')
    else:
        path.write_text("mine")


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("voxel_size", [None, (2.0, 3.0, 4.0)])
@pytest.mark.parametrize("kind", [np.float32, np.uint16, np.float64])
def test_images_written_here_are_known(name, voxel_size, kind, tmp_path):
    path = tmp_path / name
    io.write(path, IMAGE.astype(kind), voxel_size=voxel_size)
    assert is_own(path)
    assert np.array_equal(io.read(path).data, IMAGE)
    io.check_output(path, overwrite=False)


def test_other_files_written_here_are_known(tmp_path):
    assert is_own(noiseflow.save(noiseflow.Gaussian(), tmp_path / "m.safetensors"))
    assert is_own(Report("A title", "words").save(tmp_path / "index.html"))
    io.write(tmp_path / "tilts.mrc", IMAGE)
    write_angles(tmp_path / "tilts.rawtlt", np.arange(3.0))
    assert is_own(tmp_path / "tilts.rawtlt")


@pytest.mark.parametrize("name", [*OWN, "tilts.rawtlt", "m.safetensors", "index.html", "notes.txt"])
def test_files_of_others_are_refused_but_for_overwrite(name, tmp_path):
    path = tmp_path / name
    foreign(path)
    suffixes = frozenset({path.suffix})
    with pytest.raises(FileExistsError, match="--overwrite"):
        io.check_output(path, suffixes=suffixes, overwrite=False)
    io.check_output(path, suffixes=suffixes, overwrite=True)
    with pytest.raises(FileExistsError, match=name):
        Outputs(overwrite=False).folder(tmp_path, holds=[name])
    Outputs(overwrite=False).folder(tmp_path, holds=["other.html"])


def test_a_file_that_another_program_changed_since_is_not_ours(tmp_path):
    path = tmp_path / "volume.mrc"
    io.write(path, IMAGE)
    with mrcfile.open(path, "r+") as file:  # as IMOD does
        file.add_label("Trimvol: cut out of it")
    assert not is_own(path)


def test_free_names_and_empty_files_may_be_written(tmp_path):
    (tmp_path / "empty.mrc").touch()
    for name in ("empty.mrc", "none.mrc"):
        io.check_output(tmp_path / name, overwrite=False)


@pytest.mark.parametrize("name", OWN)
def test_a_link_to_a_file_of_others_is_refused_too(name, tmp_path):
    foreign(tmp_path / name)
    link = tmp_path / f"link-{name}"
    link.symlink_to(tmp_path / name)
    with pytest.raises(FileExistsError, match="--overwrite"):
        io.check_output(link, overwrite=False)


@pytest.mark.parametrize("suffix", [".mrc", ".tif", ".npy", ".safetensors", ".html", ".zarr", ".rawtlt"])
def test_damaged_files_are_nobodys(suffix, tmp_path):
    generator = np.random.default_rng(0)
    for number in range(20):
        path = tmp_path / f"{number}{suffix}"
        path.write_bytes(generator.bytes(int(generator.integers(1, 2000))))
        assert not is_own(path)


def test_npy_files_are_read_by_numpy_and_mapped(tmp_path):
    for number, array in enumerate((IMAGE, IMAGE.T, IMAGE[:, ::2], IMAGE.astype(">i2"), IMAGE[0].astype(np.float16))):
        path = tmp_path / f"{number}.npy"
        io.write(path, array)
        for mode in (None, "r"):
            found = np.load(path, mmap_mode=mode)
            assert found.dtype == array.dtype
            assert np.array_equal(found, array)
        assert os.path.getsize(path) == 1024 + array.nbytes
