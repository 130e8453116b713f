"""MRC of every maker: modes, byte orders, signed bytes, extended headers; written byte by byte from the formats' texts."""

import warnings
from pathlib import Path

import mrcfile
import numpy as np
import pytest
from mrcfile.dtypes import HEADER_DTYPE

from noiseflow import io

STACK = np.arange(60).reshape(3, 4, 5)
ANGLES = [-60.0, 0.25, 59.5]
MODES = {0: "i1", 1: "i2", 2: "f4", 6: "u2", 12: "f2"}


def write(path: Path, data: np.ndarray, mode: int, *, order: str = "<", extended: bytes = b"", **fields) -> Path:
    """An MRC file as other programs write it."""
    header = np.zeros((), HEADER_DTYPE.newbyteorder(order))
    header["nz"], header["ny"], header["nx"] = data.shape
    header["mode"], header["nsymbt"], header["map"] = mode, len(extended), b"MAP "
    header["mx"], header["my"], header["mz"] = data.shape[::-1]
    header["cella"]["x"], header["cella"]["y"], header["cella"]["z"] = (2.5 * edge for edge in data.shape[::-1])
    header["machst"] = [0x11, 0x11, 0, 0] if order == ">" else [0x44, 0x44, 0, 0]
    for name, value in fields.items():
        header[name] = value
    path.write_bytes(header.tobytes() + extended + data.tobytes())
    return path


def imod(order: str = "<", *, num_bytes: int = 0, flags: int = 0, signed: bool = False) -> bytes:
    """The part of the header that IMOD and SerialEM use."""
    extra = np.zeros(84, "u1")
    extra[16:20] = np.array([num_bytes, flags], f"{order}i2").view("u1")
    extra[40:48] = np.array([1146047817, signed], f"{order}i4").view("u1")
    return extra.tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_in_both_byte_orders_is_bit_exact(tmp_path: Path, mode: int, order: str) -> None:
    data = STACK.astype(MODES[mode])
    image = io.read(write(tmp_path / "a.st", data.astype(order + MODES[mode]), mode, order=order))
    np.testing.assert_array_equal(image.data, data)
    assert image.data.dtype == np.dtype(MODES[mode])
    assert image.voxel_size == pytest.approx((2.5, 2.5, 2.5))


@pytest.mark.parametrize("order", ["<", ">"])
def test_wrong_machine_stamp_is_found_out(tmp_path: Path, order: str) -> None:
    wrong = [0x44, 0x44, 0, 0] if order == ">" else [0x11, 0x11, 0, 0]
    path = write(tmp_path / "a.mrc", STACK.astype(f"{order}i2"), 1, order=order, machst=wrong)
    with pytest.warns(UserWarning, match="endian"):
        np.testing.assert_array_equal(io.read(path).data, STACK)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"extra2": imod()}, "u1"),
        ({"extra2": imod(signed=True)}, "i1"),
        ({"dmax": 255.0}, "u1"),
        ({"dmin": -128.0, "dmax": 127.0}, "i1"),
    ],
)
def test_bytes_are_signed_as_the_file_says(tmp_path: Path, fields: dict, expected: str) -> None:
    data = np.arange(250, 256, dtype="u1").reshape(1, 2, 3)
    image = io.read(write(tmp_path / "a.mrc", data, 0, **fields))
    np.testing.assert_array_equal(image.data, data.view(expected)[0])


@pytest.mark.parametrize("mode", [3, 4, 16, 101])
def test_complex_colour_and_packed_pixels_are_refused_by_name(tmp_path: Path, mode: int) -> None:
    path = write(tmp_path / "a.mrc", np.zeros((1, 4, 40), "f4"), mode, nx=4)
    with pytest.raises(ValueError, match=r"complex numbers|colour|4-bit") as caught:
        io.read(path)
    assert "damaged" not in str(caught.value)


def test_map_axes_are_put_in_order(tmp_path: Path) -> None:
    image = io.read(write(tmp_path / "a.map", STACK.astype("f4"), 2, mapc=3, mapr=2, maps=1))
    np.testing.assert_array_equal(image.data, STACK.transpose(2, 1, 0))


@pytest.mark.parametrize("order", ["<", ">"])
def test_tilt_angles_of_serialem(tmp_path: Path, order: str) -> None:
    record = np.zeros((3, 4), f"{order}i2")  # tilt angle, then the two stage coordinates, then magnification
    record[:, 0] = [round(100 * angle) for angle in ANGLES]
    record[:, 1:] = 77
    fields = {"extra2": imod(order, num_bytes=8, flags=1 + 4 + 8), "exttyp": b"SERI"}
    path = write(tmp_path / "a.st", STACK.astype(f"{order}i2"), 1, order=order, extended=record.tobytes(), **fields)
    image = io.read(path)
    np.testing.assert_allclose(image.tilt_angles, ANGLES)
    np.testing.assert_array_equal(image.data, STACK)


def test_tilt_angles_of_old_fei_headers(tmp_path: Path) -> None:
    record = np.zeros((1024, 32), "<f4")
    record[:3, 0] = ANGLES
    extra = imod(flags=32)[:40] + bytes(44)
    image = io.read(write(tmp_path / "a.mrc", STACK.astype("i2"), 1, extended=record.tobytes(), extra2=extra))
    np.testing.assert_allclose(image.tilt_angles, ANGLES)


@pytest.mark.parametrize("kind", [b"FEI1", b"FEI2"])
def test_tilt_angles_of_fei_headers(tmp_path: Path, kind: bytes) -> None:
    record = np.zeros(3, mrcfile.dtypes.get_ext_header_dtype(kind, "<"))
    record["Metadata size"], record["Alpha tilt"] = record.itemsize, ANGLES
    image = io.read(write(tmp_path / "a.mrc", STACK.astype("i2"), 1, extended=record.tobytes(), exttyp=kind))
    np.testing.assert_allclose(image.tilt_angles, ANGLES)


def test_extended_header_without_angles_gives_none(tmp_path: Path) -> None:
    for extended, fields in ((bytes(80), {"exttyp": b"CCP4"}), (bytes(6), {"exttyp": b"FEI1"}), (bytes(96), {})):
        path = write(tmp_path / "a.mrc", STACK.astype("i2"), 1, extended=extended, **fields)
        assert io.read(path).tilt_angles is None
        np.testing.assert_array_equal(io.read(path).data, STACK)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "f2", "f4", "i4", "u4", "i8"])
def test_written_values_come_back_exactly(tmp_path: Path, dtype: str) -> None:
    values = np.array([[0, 1, 100], [127, 3, 5]]).astype(dtype)
    io.write(tmp_path / "a.mrc", values)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(io.read(tmp_path / "a.mrc").data, values)


def test_integers_that_would_lose_digits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="lose digits"):
        io.write(tmp_path / "a.mrc", np.array([[2**24 + 1, 0]]))
    assert not list(tmp_path.iterdir())


def test_claims_of_any_size_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    for nx, nz, nsymbt in ((2**31 - 1, 2**31 - 1, 0), (10_000, 10_000, 0), (5, 3, 2**31 - 1), (-5, -3, 0), (5, 3, -1)):
        path = write(tmp_path / "a.mrc", STACK.astype("f4"), 2, nx=nx, nz=nz, nsymbt=nsymbt)
        with pytest.raises(ValueError, match="header claims"):
            io.read(path)


@pytest.mark.parametrize("kind", [np.float32, np.int16, np.float64])
@pytest.mark.parametrize("shape", [(7, 8, 9), (8, 9)])
def test_header_statistics_are_those_of_the_pixels(kind, shape, tmp_path):
    data = (1000 * np.random.default_rng(0).normal(3.0, 1.0, shape)).astype(kind)
    io.write(tmp_path / "stack.mrc", data)
    with mrcfile.open(tmp_path / "stack.mrc") as file:
        header = file.header
        found = [float(header[name]) for name in ("dmin", "dmax", "dmean", "rms")]
    np.testing.assert_allclose(found, [data.min(), data.max(), data.mean(), data.std()], rtol=1e-5)
