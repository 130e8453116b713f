"""TIFF: all number types bit for bit, voxel sizes of ImageJ and OME, colours refused, folders of images."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from noiseflow import io
from noiseflow.io.folder import angles_in_names

STACK = np.arange(60).reshape(3, 4, 5)
TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "f2", "f4", "f8", "i8", "u8"]
OUTSIDE_OME = ["f2", "i8", "u8"]


@pytest.mark.parametrize("voxel_size", [None, (3.0, 2.0, 1.5)])
@pytest.mark.parametrize("dtype", TYPES)
def test_every_type_is_bit_exact_and_keeps_its_voxel_size(tmp_path: Path, dtype: str, voxel_size) -> None:
    io.write(tmp_path / "a.tif", STACK.astype(dtype), voxel_size=voxel_size)
    image = io.read(tmp_path / "a.tif")
    np.testing.assert_array_equal(image.data, STACK.astype(dtype))
    assert image.data.dtype == np.dtype("f4" if dtype in OUTSIDE_OME and voxel_size else dtype)
    assert image.voxel_size == (None if voxel_size is None else pytest.approx(voxel_size, rel=1e-6))


@pytest.mark.parametrize(
    ("labels", "angles"),
    [
        (["tilt = -60", "tilt = 0", "tilt = 60"], [-60, 0, 60]),
        (["cell_-1.5.tif\nInfo", "cell_0.0.tif\nInfo", "cell_1.5.tif\nInfo"], [-1.5, 0, 1.5]),
        (["c:1/1 z:1/3 - a.mrc", "c:1/1 z:2/3 - a.mrc", "c:1/1 z:3/3 - a.mrc"], None),
        (["tilt = -60", "tilt = 0"], None),
    ],
)
def test_labels_of_imagej_hold_angles(tmp_path: Path, labels: list[str], angles: list[float] | None) -> None:
    metadata = {"axes": "ZYX", "Labels": labels}
    tifffile.imwrite(tmp_path / "a.tif", STACK.astype("u2"), imagej=True, metadata=metadata)
    found = io.read(tmp_path / "a.tif").tilt_angles
    assert found is None if angles is None else list(found) == angles


@pytest.mark.parametrize(("unit", "angstrom"), [("Å", 1.0), ("nm", 10.0), ("µm", 1e4), (None, 1e4), ("mm", 1e7)])
def test_ome_units(tmp_path: Path, unit: str | None, angstrom: float) -> None:
    sizes = {f"PhysicalSize{axis}": 2.0 for axis in "XY"}
    units = {f"PhysicalSize{axis}Unit": unit for axis in "XY"} if unit else {}
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, STACK.astype("u2"), ome=True, metadata={"axes": "ZYX", **sizes, **units})
    image = io.read(path)
    np.testing.assert_array_equal(image.data, STACK)
    assert image.voxel_size == pytest.approx((2 * angstrom,) * 3)


@pytest.mark.parametrize(("unit", "angstrom"), [("nm", 10.0), ("micron", 1e4), ("\\u00B5m", 1e4), ("angstrom", 1.0)])
def test_imagej_units(tmp_path: Path, unit: str, angstrom: float) -> None:
    metadata = {"unit": unit, "spacing": 4.0}
    tifffile.imwrite(tmp_path / "a.tif", STACK.astype("u2"), imagej=True, resolution=(0.5, 1.0), metadata=metadata)
    expected = (4 * angstrom, angstrom, 2 * angstrom)
    assert io.read(tmp_path / "a.tif").voxel_size == pytest.approx(expected, rel=1e-6)


def test_dots_per_inch_are_no_pixel_size(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", STACK[0].astype("u2"), resolution=(300, 300), resolutionunit="INCH")
    assert io.read(tmp_path / "a.tif").voxel_size is None


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_colour_is_refused_by_name(tmp_path: Path, dtype: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.arange(216).reshape(8, 9, 3).astype(dtype), photometric="rgb")
    with pytest.raises(ValueError, match="is a colour image") as caught:
        io.read(tmp_path / "a.tif")
    assert "damaged" not in str(caught.value)


@pytest.mark.parametrize("number", [3, 4])
def test_frames_that_their_program_tagged_as_colours_are_read(tmp_path: Path, number: int) -> None:
    frames = np.arange(number * 20, dtype="u2").reshape(number, 4, 5)
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="rgb", planarconfig="separate")
    with pytest.warns(UserWarning, match="frames"):
        np.testing.assert_array_equal(io.read(tmp_path / "a.tif").data, frames)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_claims_beyond_the_file_are_refused(tmp_path: Path, compression: str | None) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((8, 8), "u1"), compression=compression)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        for tag in ("ImageWidth", "ImageLength", "RowsPerStrip"):
            tiff.pages.first.tags[tag].overwrite(2**20 if tag != "RowsPerStrip" else 8)
    with pytest.raises(ValueError, match="cannot be read"):
        io.read(path)


def test_frames_appended_one_by_one_are_a_stack(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for image in STACK.astype("u2"):
            file.write(image)
    for mapped in (False, True):
        np.testing.assert_array_equal(io.read(tmp_path / "a.tif", mapped=mapped).data, STACK)
    tifffile.imwrite(tmp_path / "a.tif", STACK[0, :2].astype("u2"), append=True)
    with pytest.raises(ValueError, match="several images"):
        io.read(tmp_path / "a.tif")


def folder_of(tmp_path: Path, names: list[str]) -> Path:
    folder = tmp_path / "series"
    folder.mkdir()
    for index, name in reversed(list(enumerate(names))):
        tifffile.imwrite(folder / name, STACK[index % 3].astype("u2"))
    return folder


def test_folder_reads_in_natural_order(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["img1.tif", "img2.tif", "img10.tif"])
    (folder / "notes.txt").write_text("x")
    (folder / "._img1.tif").write_bytes(b"x")
    image = io.read(folder)
    np.testing.assert_array_equal(image.data, STACK)
    assert image.tilt_angles is None


def test_folder_pairs_angles_of_the_names_with_their_images(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["TS01_-2.0.tif", "TS01_0.0.tif", "TS01_2.0.tif"])
    image = io.read(folder)
    for index, angle in ((0, -2.0), (1, 0.0), (2, 2.0)):
        position = list(image.tilt_angles).index(angle)
        np.testing.assert_array_equal(image.data[position], STACK[index])


@pytest.mark.parametrize(
    ("names", "angles"),
    [
        (["TS_01_000_0.00.tif", "TS_01_001_-3.00.tif", "TS_01_002_3.00.tif"], [0, -3, 3]),
        (["a+10.tif", "a-10.tif", "a+0.tif"], [10, -10, 0]),
        (["tilt-10.tif", "tilt--10.tif", "tilt-0.tif"], [10, -10, 0]),
        (["tilt_5.tif", "tilt_10.tif"], [5, 10]),
        (["s1_m60.tif", "s1_p00.tif", "s1_P60.tif"], [-60, 0, 60]),
        (["neg60deg.tif", "neg_5deg.tif", "50deg.tif"], [-60, -5, 50]),
        (["m_-5.0.tif", "m_0.0.tif", "m_5.0.tif"], [-5, 0, 5]),
        (["m-5.0.tif", "m0.0.tif", "m5.0.tif"], [-5, 0, 5]),
        (["p10.tif", "p20.tif"], None),
        (["n10.tif", "n20.tif"], None),
        (["img_001.tif", "img_002.tif"], None),
        (["tilt-5.tif", "tilt-10.tif"], None),
        (["a_1.0_2.0.tif", "a_3.0_4.0.tif"], None),
        (["a_400.5.tif", "a_3.5.tif"], None),
        (["a_1.5.tif", "b.tif"], None),
    ],
)
def test_angles_in_names_are_told_or_not_guessed(names: list[str], angles: list[float] | None) -> None:
    found = angles_in_names(names)
    assert found is None if angles is None else list(found) == angles


def test_folders_of_nothing_stacks_and_unequal_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="without images"):
        io.read(tmp_path)
    tifffile.imwrite(tmp_path / "1.tif", STACK[0].astype("u2"))
    tifffile.imwrite(tmp_path / "2.tif", STACK[0, :2].astype("u2"))
    with pytest.raises(ValueError, match="same size"):
        io.read(tmp_path)
    tifffile.imwrite(tmp_path / "1.tif", STACK.astype("u2"), photometric="minisblack")
    with pytest.raises(ValueError, match="single images"):
        io.read(tmp_path)


def test_pages_in_a_circle_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        for section in STACK.astype("u2"):
            writer.write(section, metadata=None)
    with tifffile.TiffFile(path) as tiff:
        first, last = tiff.pages[0].offset, tiff.pages[2]
        end = last.offset + 2 + 12 * len(last.tags)
    content = path.read_bytes()
    path.write_bytes(content[:end] + first.to_bytes(4, "little") + content[end + 4 :])
    with pytest.raises(ValueError, match="is circular"):
        io.read(path)
