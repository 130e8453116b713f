"""Files in and out: round trips, damage of every kind, and nothing half-written."""

from pathlib import Path

import cv2
import mrcfile
import numpy as np
import pytest
import tifffile
from PIL import Image

from noiseflow import io

IMAGE = np.arange(60, dtype=np.float32).reshape(3, 4, 5)


@pytest.mark.parametrize("suffix", [".mrc", ".tif", ".npy", ".st", ".rec"])
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.float32])
def test_round_trip(tmp_path: Path, suffix: str, dtype: type) -> None:
    path = tmp_path / f"image{suffix}"
    io.write(path, IMAGE.astype(dtype))
    assert np.array_equal(io.read(path).data, IMAGE.astype(dtype))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".mrc", ".tif"])
def test_voxel_size_is_carried(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image{suffix}"
    io.write(path, IMAGE, voxel_size=(3.0, 2.0, 1.5))
    assert io.read(path).voxel_size == pytest.approx((3.0, 2.0, 1.5), rel=1e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_png_files_are_read_as_they_are(tmp_path: Path, dtype: type) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (20, 30), dtype, endpoint=True)
    assert cv2.imwrite(str(tmp_path / "image.png"), image)
    found = io.read_image(tmp_path / "image.png")
    assert found.dtype == dtype
    assert np.array_equal(found, image)


@pytest.mark.parametrize(("mode", "pixel"), [("RGB", (1, 2, 1)), ("P", 0), ("LA", (1, 2)), ("RGBA", (1, 1, 1, 2))])
def test_png_files_that_are_not_grey_are_refused(tmp_path: Path, mode: str, pixel: int | tuple[int, ...]) -> None:
    image = Image.new(mode, (9, 8))
    image.putpixel((3, 2), pixel)
    image.save(tmp_path / "image.png")
    with pytest.raises(ValueError, match="save one colour as a grey image"):
        io.read(tmp_path / "image.png")


@pytest.mark.parametrize("colours", [2, 3, 4])
def test_grey_images_saved_in_colour_are_read_as_grey(tmp_path: Path, colours: int) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (5, 20, 30), np.uint8)
    coloured = np.repeat(grey[..., None], colours, -1)
    if colours != 3:
        coloured[..., -1] = 255
    Image.fromarray(coloured[0]).save(tmp_path / "image.png")
    np.testing.assert_array_equal(io.read_image(tmp_path / "image.png"), grey[0])
    if colours == 3:
        tifffile.imwrite(tmp_path / "stack.tif", coloured, photometric="rgb")
        np.testing.assert_array_equal(io.read(tmp_path / "stack.tif", mapped=True).data, grey)
        assert cv2.imwrite(str(tmp_path / "deep.png"), coloured[0].astype(np.uint16) * 257)
        with pytest.raises(ValueError, match="save one colour as a grey image"):
            io.read(tmp_path / "deep.png")


def test_png_files_cut_short_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 60), np.uint8)).save(path)
    whole = path.read_bytes()
    for size in (4, 40, len(whole) // 2, len(whole) - 100):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="cannot be read"):
            io.read(path)


def test_real_files_open(data: Path) -> None:
    series = io.read(data / "tilt_needle" / "needle_aligned.mrc")
    assert series.data.shape == (91, 64, 64)
    assert series.voxel_size == pytest.approx((179.949,) * 3, rel=1e-5)
    assert io.read_image(data / "exposures_miro" / "channel1_050ms.tif").dtype == np.uint16


def test_truncation_at_any_place_is_one_clear_error(tmp_path: Path, data: Path) -> None:
    for source in (data / "tilt_needle" / "needle_aligned.mrc", data / "exposures_miro" / "channel1_050ms.tif"):
        whole = source.read_bytes()
        for size in [1, 3, 100, 1023, 1024, *range(2048, len(whole) - 1, len(whole) // 20)]:
            path = tmp_path / f"cut{source.suffix}"
            path.write_bytes(whole[:size])
            with pytest.raises(ValueError, match="cannot be read"):
                io.read(path)


def test_absurd_header_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "absurd.mrc"
    with mrcfile.new(path, data=IMAGE) as mrc:
        mrc.header.nx = mrc.header.ny = 1_000_000
    with pytest.raises(ValueError, match="claims 1000000 x 1000000"):
        io.read(path)


NPY = b"\x93NUMPY\x01\x00v\x00"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.mrc", b"", "empty"),
        ("text.tif", b"not an image at all", "cannot be read"),
        ("text.mrc", b"x" * 4096, "cannot be read"),
        ("code.npy", NPY + b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", "cannot be read"),
        (
            "number.npy",
            NPY + b"{'descr': '<f8', 'fortran_order': False, 'shape': ()}".ljust(117) + b"\n" + bytes(8),
            "0 dim",
        ),
        ("image.jpeg", b"x", "compressed with loss"),
        ("image.cr2", b"x", "unprocessed_raw"),
        ("image.xyz", b"x", "unknown file type"),
    ],
)
def test_wrong_content_is_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        io.read(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        io.read(tmp_path / "none.mrc")


def test_colour_and_complex_images_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "colour.tif", np.arange(216, dtype=np.uint8).reshape(8, 9, 3), photometric="rgb")
    np.save(tmp_path / "complex.npy", np.zeros((2, 2), complex))
    with pytest.raises(ValueError, match="colour"):
        io.read(tmp_path / "colour.tif")
    with pytest.raises(ValueError, match="complex128"):
        io.read(tmp_path / "complex.npy")


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "image.npy"
    io.write(path, IMAGE)

    def fail_half_way() -> None:
        with io.atomic_path(path) as partial:
            partial.write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert np.array_equal(io.read(path).data, IMAGE)
    assert len(list(tmp_path.iterdir())) == 1


def test_output_is_checked_before_work(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"volume\.jpg"):
        io.check_output(tmp_path / "volume.jpg")
    with pytest.raises(FileNotFoundError, match="create the folder"):
        io.check_output(tmp_path / "none" / "volume.mrc")


def test_bad_pixels_are_named() -> None:
    bad = IMAGE.copy()
    bad[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"1 NaN or infinite pixels, the first at \(1, 2, 3\)"):
        io.require_finite(bad, "tilts.mrc")
    with pytest.raises(ValueError, match="flat"):
        io.require_contrast(np.ones((2, 2)), "tilts.mrc")
    for unit in (1e-18, 1e18):
        with pytest.raises(ValueError, match="scale all"):
            io.require_contrast(unit * np.eye(2), "tilts.mrc")
    io.require_contrast(1e-12 * np.eye(2), "tilts.mrc")
