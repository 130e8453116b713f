"""More than 2³¹ voxels, pixels or non-zeros: the last element is right. Files are sparse and arrays virtual, and hold nothing."""

import os

import mrcfile
import numpy as np
import pytest

from noiseflow import io
from noiseflow.arrays import strided
from noiseflow.io import mapped
from noiseflow.io.mapped import create_volume, temporary_map
from recon.projection.base import PanelledMatrix
from recon.scale.blocks import HALO, block_memory, blocks
from recon.scale.memory import choose_slices, needed_memory
from recon.series.tilt_series import TiltSeries, VolumeGrid

EDGE = 1300
SHAPE = (EDGE,) * 3
assert np.prod(SHAPE, dtype=object) > 2**31


@pytest.fixture(autouse=True)
def sparse(monkeypatch):
    """Files take no room on the disk before something is written into them."""
    monkeypatch.setattr(mapped, "reserve_room", os.ftruncate)


@pytest.mark.parametrize("name", ["v.npy", "v.mrc"])
def test_the_last_voxel_of_a_file_is_written_and_read(tmp_path, name):
    volume = create_volume(tmp_path / name, SHAPE)
    volume[-1, -1, -1], volume[0, -1, -1] = 5, 3
    volume.flush()
    found = io.read(tmp_path / name, mapped=True).data
    assert found.shape == SHAPE
    assert (found[-1, -1, -1], found[0, -1, -1], found[-1, 0, 0]) == (5, 3, 0)
    last = blocks(EDGE, 64, HALO)[-1]
    assert found[:, last.wide][-1, -1, -1] == 5
    assert strided(found, 100).shape == (100,) * 3


def test_stacks_of_other_programs_are_read_to_the_last_pixel(tmp_path):
    path = tmp_path / "tilts.mrc"
    mrcfile.new(path, np.zeros((2, 3, 4), np.uint16)).close()
    count, edge = 79, 5300
    with path.open("r+b") as stream:
        stream.write(np.array([edge, edge, count], "<i4").tobytes())
        stream.truncate(1024 + 2 * count * edge**2)
        stream.seek(-2, 2)
        stream.write(b"\x07\x00")
    images = io.read(path, mapped=True).data
    assert images.size > 2**31
    assert images[-1, -1, -1] == 7
    little = TiltSeries(np.arange(8.0).reshape(2, 2, 2), np.array([0.0, 5.0]))
    part = little.with_images(images, None).rows(slice(edge - 4, edge))
    assert part.images[-1, -1, -1] == 7


def test_the_last_element_of_a_temporary_file_is_kept(tmp_path):
    array = temporary_map(SHAPE, np.uint8, folder=tmp_path)
    array[-1, -1, -1] = 9
    assert (array.reshape(-1)[EDGE**3 - 1], array[-1, -1, -2]) == (9, 0)


def test_the_last_entry_of_a_wide_matrix_stands_in_the_last_column():
    width = 2**31 + 5
    rows, columns = np.array([0, 2]), np.array([0, width - 1])
    for panel in (2**30, width):
        matrix = PanelledMatrix.of(rows, columns, np.array([1.0, 2.0]), (3, width), panel=panel)
        found = matrix.entries()
        assert (found[0][-1], found[1][-1], found[2][-1]) == (2, width - 1, 2.0)
        assert matrix.shape == (3, width)


def test_memory_of_64_gigavoxels_is_counted():
    class Virtual(TiltSeries):
        def __init__(self, edge):
            object.__setattr__(self, "images", np.broadcast_to(np.float32(1), (79, edge, edge)))
            object.__setattr__(self, "mask", None)
            object.__setattr__(self, "tilt_angles", np.arange(79.0))

    series, grid = Virtual(4000), VolumeGrid(4000, 4000, 4000)
    assert needed_memory(series, grid) > 64 * grid.depth * grid.height * grid.width
    slices = choose_slices(series, grid, 2**38)
    assert slices is not None
    assert 2**36 < needed_memory(*block_memory(series, grid, slices, fitted=True)) < 2**38
