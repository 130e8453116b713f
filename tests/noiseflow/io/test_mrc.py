"""MRC of every maker: modes, byte orders, signed bytes, extended headers; written byte by byte from the formats' texts."""

import gzip
import warnings
from itertools import permutations
from pathlib import Path

import mrcfile
import numpy as np
import pytest
from mrcfile.dtypes import HEADER_DTYPE

from noiseflow import io
from noiseflow.io import mrc

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


def imod(order: str = "<", *, num_bytes: int = 0, flags: int = 0, signed: int = 0) -> bytes:
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
        ({"dmax": 255.0}, "u1"),
        ({"dmin": -128.0, "dmax": 127.0}, "i1"),
    ],
)
def test_bytes_are_signed_as_the_file_says(tmp_path: Path, fields: dict, expected: str) -> None:
    data = np.arange(250, 256, dtype="u1").reshape(1, 2, 3)
    image = io.read(write(tmp_path / "a.mrc", data, 0, **fields))
    np.testing.assert_array_equal(image.data, data.view(expected)[0])


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("flags", [1, 3])
def test_signed_bytes_of_imod_are_grey_levels_less_128(tmp_path: Path, flags: int, order: str, mapped: bool) -> None:
    grey = np.arange(0, 240, 4, dtype="u1").reshape(3, 4, 5)
    stored = (grey.astype("i2") - 128).astype("i1")
    path = write(tmp_path / "a.mrc", stored, 0, order=order, extra2=imod(order, signed=flags), dmin=-128.0, dmax=108.0)
    image = io.read(path, mapped=mapped)
    assert image.data.dtype == np.uint8
    np.testing.assert_array_equal(image.data, grey)


@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_unsigned_pixels_without_statistics_are_told_from_signed_ones(tmp_path: Path, kind: str) -> None:
    top = np.iinfo(kind).max
    y, x = np.mgrid[:32, :32] / 31
    noise = np.random.default_rng(0).normal(0, 0.05, (3, 32, 32))
    grey = (top * np.clip(0.5 * (x + y) + noise, 0, 1)).astype(kind)
    signed = (top * np.clip(0.25 * (x + y - 1) + noise, -0.5, 0.5)).astype(kind.replace("u", "i"))
    mode = {"u1": 0, "u2": 1}[kind]
    for data in (grey, signed):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            image = io.read(write(tmp_path / "a.mrc", data, mode))
        np.testing.assert_array_equal(image.data, data)
        assert image.data.dtype == data.dtype
        assert len(caught) == (data.dtype == np.uint16)


def test_sections_beyond_the_header_are_not_dropped_in_silence(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mrc", STACK.astype("i2"), 1, nz=2, mz=2)
    with pytest.warns(UserWarning, match="room for 1 more"):
        assert len(io.read(path).data) == 2


def test_one_volume_of_a_stack_of_volumes_is_chosen(tmp_path: Path) -> None:
    volumes = np.arange(120).reshape(6, 4, 5)
    path = write(tmp_path / "a.mrc", volumes.astype("i2"), 1, ispg=401, mz=3)
    with pytest.raises(io.SeveralImages):
        io.read(path)
    np.testing.assert_array_equal(io.read(path, channel=1).data, volumes[3:])


def test_what_is_wrong_with_a_file_names_it_and_not_the_copy_that_was_unpacked(tmp_path: Path) -> None:
    several = write(tmp_path / "a.mrc", np.zeros((6, 4, 5), "i2"), 1, ispg=401, mz=3)
    complex_ = write(tmp_path / "b.mrc", np.zeros((1, 4, 40), "f4"), 4, nx=4)
    cut_short = tmp_path / "c.mrc"
    cut_short.write_bytes(complex_.read_bytes()[:900])
    for plain in (several, complex_, cut_short):
        packed = plain.with_name(f"{plain.name}.gz")
        packed.write_bytes(gzip.compress(plain.read_bytes()))
        for path in (plain, packed):
            with pytest.raises(ValueError, match=r"holds|cannot be read") as caught:
                io.read(path)
            assert str(caught.value).startswith(f"{path} ")
            assert isinstance(caught.value, io.SeveralImages) == (plain == several)


@pytest.mark.parametrize("mode", [3, 4, 16, 101])
def test_complex_colour_and_packed_pixels_are_refused_by_name(tmp_path: Path, mode: int) -> None:
    path = write(tmp_path / "a.mrc", np.zeros((1, 4, 40), "f4"), mode, nx=4)
    with pytest.raises(ValueError, match=r"complex numbers|colour|4-bit") as caught:
        io.read(path)
    assert "damaged" not in str(caught.value)
    absurd = write(tmp_path / "b.mrc", np.zeros((1, 4, 40), "f4"), mode, nx=40_000)
    with pytest.raises(ValueError, match=f"not an MRC file: its header says mode {mode}"):
        io.read(absurd)


def test_a_mode_that_nobody_knows_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not an MRC file: its header says mode 99"):
        io.read(write(tmp_path / "a.mrc", np.zeros((1, 4, 40), "f4"), 99))


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


@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_whole_numbers_in_a_type_that_mrc_has_keep_it(tmp_path: Path, kind: type) -> None:
    io.write(tmp_path / "a.mrc", np.array([[1, 2]], kind))
    assert io.read(tmp_path / "a.mrc").data.dtype == kind


def test_integers_that_would_lose_digits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="exactly; write"):
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


def test_headers_and_pixels_must_be_there_to_the_last_byte(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mrc", STACK.astype("i2"), 1, extended=bytes(80))
    whole = path.read_bytes()
    np.testing.assert_array_equal(io.read(path).data, STACK)
    for size, words in ((len(whole) - 1, "header claims"), (1024, "header claims"), (1023, "has 1024 bytes")):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=words):
            io.read(path)
    path.write_bytes(whole + b"more")
    np.testing.assert_array_equal(io.read(path).data, STACK)
    with pytest.raises(ValueError, match="header claims"):
        io.read(write(tmp_path / "b.mrc", np.zeros((1, 1, 1), "i2"), 1, nx=0))


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_mapped_file_has_the_same_pixels_and_is_not_changed(tmp_path: Path, order: str, mapped: bool) -> None:
    path = write(tmp_path / "a.mrc", STACK.astype(f"{order}f4"), 2, order=order, extended=bytes(80))
    before = path.read_bytes()
    image = mrc.read(path, mapped=mapped)
    np.testing.assert_array_equal(image.data, STACK)
    assert mapped or not isinstance(image.data, np.memmap)
    image.data[:] = 7
    assert path.read_bytes() == before


@pytest.mark.parametrize(("space_group", "shape"), [(0, (4, 5)), (1, (1, 4, 5)), (401, (1, 4, 5))])
def test_one_section_of_a_stack_is_an_image(tmp_path: Path, space_group: int, shape: tuple[int, ...]) -> None:
    path = write(tmp_path / "a.mrc", STACK[:1].astype("i2"), 1, ispg=space_group)
    assert io.read(path).data.shape == shape


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"dmax": 127.0}, "i1"),
        ({"dmax": 127.5}, "u1"),
        ({"dmax": float("nan")}, "i1"),
        ({"extra2": imod(signed=2)}, "u1"),  # another flag of IMOD's
    ],
)
@pytest.mark.parametrize("order", ["<", ">"])
def test_flags_of_imod_count_before_statistics(tmp_path: Path, order: str, fields: dict, expected: str) -> None:
    if "extra2" in fields:
        fields = fields | {"extra2": imod(order, signed=int(np.frombuffer(fields["extra2"][44:48], "<i4")[0]))}
    data = np.arange(250, 256, dtype="u1").reshape(1, 2, 3)
    image = io.read(write(tmp_path / "a.mrc", data, 0, order=order, **fields))
    np.testing.assert_array_equal(image.data, data.view(expected)[0])


@pytest.mark.parametrize("axes", list(permutations((1, 2, 3))))
def test_every_order_of_axes_comes_out_as_z_y_x(tmp_path: Path, axes: tuple[int, int, int]) -> None:
    volume = np.arange(24).reshape(2, 3, 4).astype("f4")  # (z, y, x), axes 3, 2 and 1
    stored = volume.transpose([3 - axis for axis in axes])  # sections, rows, columns
    path = write(tmp_path / "a.map", stored, 2, maps=axes[0], mapr=axes[1], mapc=axes[2])
    np.testing.assert_array_equal(io.read(path).data, volume)


def test_axes_that_make_no_sense_are_left_as_they_are(tmp_path: Path) -> None:
    path = write(tmp_path / "a.map", STACK.astype("f4"), 2, maps=1, mapr=1, mapc=1)
    np.testing.assert_array_equal(io.read(path).data, STACK)


@pytest.mark.parametrize(
    ("edges", "cells", "expected"),
    [
        ((10.0, 40.0, 90.0), (5, 10, 15), (6.0, 4.0, 2.0)),
        ((10.0, 40.0, 90.0), (0, 10, 15), (6.0, 4.0, 10.0)),  # no number of cells: one
        ((0.0, 40.0, 90.0), (5, 10, 15), None),
        ((10.0, 40.0, float("inf")), (5, 10, 15), None),
    ],
)
def test_voxels_are_edges_over_cells(tmp_path: Path, edges, cells, expected) -> None:
    cella = np.zeros((), HEADER_DTYPE["cella"])
    cella["x"], cella["y"], cella["z"] = edges
    fields = dict(zip(("mx", "my", "mz"), cells, strict=True))
    found = io.read(write(tmp_path / "a.mrc", STACK.astype("i2"), 1, cella=cella, **fields)).voxel_size
    assert found == (None if expected is None else pytest.approx(expected))


def angles_of(path: Path, data: bytes, extra: bytes, kind: bytes = b"", sections: int = 3, order: str = "<"):
    stack = np.zeros((sections, 2, 2), f"{order}i2")
    return io.read(write(path, stack, 1, order=order, extended=data, extra2=extra, exttyp=kind)).tilt_angles


@pytest.mark.parametrize("flags", range(1, 64, 2))
def test_serialem_records_of_every_kind_are_as_long_as_their_flags_say(tmp_path: Path, flags: int) -> None:
    lengths = {1: 2, 2: 6, 4: 4, 8: 2, 16: 2, 32: 4}
    size = sum(length for bit, length in lengths.items() if flags & bit)
    record = np.full((3, size // 2), 999, "<i2")
    record[:, 0] = [-6000, 25, 5950]
    found = angles_of(tmp_path / "a.st", record.tobytes(), imod(num_bytes=size, flags=flags), b"SERI")
    np.testing.assert_allclose(found, ANGLES)
    wrong = angles_of(tmp_path / "b.st", bytes(300), imod(num_bytes=size + 2, flags=flags), b"SERI")
    assert wrong is None
    without = imod(num_bytes=size - 2, flags=flags - 1)
    assert angles_of(tmp_path / "c.st", record.tobytes(), without, b"SERI") is None


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [b"AGAR", b"", b"\0\0\0\0"])
def test_agards_records_have_integers_before_the_angle(tmp_path: Path, kind: bytes, order: str) -> None:
    record = np.full((3, 6), 55.0, f"{order}f4")
    record[:, 2] = ANGLES
    extra = imod(order, num_bytes=2, flags=4)[:40] + bytes(44)  # 2 integers and 4 reals
    np.testing.assert_allclose(angles_of(tmp_path / "a.mrc", record.tobytes(), extra, kind, order=order), ANGLES)
    short = record.tobytes()[: 2 * 24 + 12]
    np.testing.assert_allclose(angles_of(tmp_path / "b.mrc", short, extra, kind, order=order), ANGLES)
    assert angles_of(tmp_path / "c.mrc", short[:-1], extra, kind, order=order) is None
    assert angles_of(tmp_path / "d.mrc", record.tobytes(), extra, b"CCP4", order=order) is None
    none = imod(order, num_bytes=2, flags=0)[:40] + bytes(44)
    assert angles_of(tmp_path / "e.mrc", record.tobytes(), none, kind, order=order) is None


@pytest.mark.parametrize(
    ("angles", "told"),
    [
        ([-180.0, 0.0, 180.0], True),
        ([-180.0, 0.0, 180.5], False),
        ([5.0, 5.0, 5.0], False),  # a stage that never moved wrote no angles
        ([0.0, float("nan"), 2.0], False),
        ([0.0, 0.0, 0.5], True),
        ([7.0], True),
    ],
)
def test_numbers_that_can_be_no_angles_are_none(tmp_path: Path, angles: list[float], told: bool) -> None:
    record = np.zeros((len(angles), 32), "<f4")
    record[:, 0] = angles
    extra = imod(flags=32)[:40] + bytes(44)
    found = angles_of(tmp_path / "a.mrc", record.tobytes(), extra, sections=len(angles))
    assert (found is not None) == told


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [b"FEI1", b"FEI2"])
def test_fei_records_are_as_long_as_the_first_says_and_hold_the_axis(tmp_path: Path, kind: bytes, order: str) -> None:
    record = np.zeros(3, mrcfile.dtypes.get_ext_header_dtype(kind, order))
    longer = record.itemsize + 24
    record["Metadata size"], record["Alpha tilt"], record["Tilt axis angle"] = longer, ANGLES, 85.5
    raw = b"".join(one.tobytes() + bytes(24) for one in record)
    stack = np.zeros((3, 2, 2), f"{order}i2")
    image = io.read(write(tmp_path / "a.mrc", stack, 1, order=order, extended=raw, exttyp=kind))
    np.testing.assert_allclose(image.tilt_angles, ANGLES)
    assert image.tilt_axis == pytest.approx(85.5)
    for stated, expected in ((0.0, None), (360.0, 360.0), (360.5, None), (-400.0, None), (-5.0, -5.0)):
        record["Tilt axis angle"] = stated
        raw = b"".join(one.tobytes() + bytes(24) for one in record)
        image = io.read(write(tmp_path / "b.mrc", stack, 1, order=order, extended=raw, exttyp=kind))
        assert image.tilt_axis == expected
    empty = io.read(write(tmp_path / "c.mrc", stack, 1, order=order, extended=b"", exttyp=kind))
    assert (empty.tilt_angles, empty.tilt_axis) == (None, None)


def test_the_axis_of_old_headers_needs_all_their_reals(tmp_path: Path) -> None:
    record = np.zeros((3, 31), "<f4")
    record[:, 0], record[:, 10] = ANGLES, 85.0
    extra = imod(flags=31)[:40] + bytes(44)
    path = write(tmp_path / "a.mrc", STACK.astype("i2"), 1, extended=record.tobytes(), extra2=extra)
    assert io.read(path).tilt_axis is None


@pytest.mark.parametrize(("values", "stored"), [([-5, 300], "i2"), ([0, 60_000], "u2"), ([0, 2**24], "f4")])
def test_wide_integers_are_written_in_the_narrowest_type_that_holds_them(tmp_path: Path, values, stored: str) -> None:
    io.write(tmp_path / "a.mrc", np.array([values], np.int64))
    found = io.read(tmp_path / "a.mrc").data
    assert found.dtype == np.dtype(stored)
    np.testing.assert_array_equal(found, [values])


def test_written_voxel_sizes_and_labels(tmp_path: Path) -> None:
    io.write(tmp_path / "a.mrc", STACK.astype("f4"), voxel_size=(3.0, 2.0, 1.0))
    with mrcfile.open(tmp_path / "a.mrc") as file:
        assert (float(file.voxel_size.x), float(file.voxel_size.z)) == pytest.approx((1.0, 3.0))
        assert bytes(file.header.label[int(file.header.nlabl) - 1]).startswith(b"noiseflow")
    assert io.read(tmp_path / "a.mrc").voxel_size == pytest.approx((3.0, 2.0, 1.0))
