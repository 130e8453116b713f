"""Frames of cameras, written byte by byte as their formats say, are read unchanged."""

import struct

import numpy as np
import pytest
import scipy.io
import tifffile

from calibration.exposures.frames import frames_of
from noiseflow.io import read
from noiseflow.io.camera_formats import READERS
from noiseflow.io.checks import SeveralImages
from noiseflow.io.image_file import FORMATS, PNG_SUFFIX, by_axes

FRAMES = np.random.default_rng(0).integers(0, 60_000, (5, 20, 30)).astype(np.uint16)


def fits_bytes(cards, data=b""):
    header = "".join(f"{name:8s}= {value:>20}".ljust(80) for name, value in cards.items()) + "END".ljust(80)
    pad = -len(header) % 2880
    return (header + pad * " ").encode() + data + b"\0" * (-len(data) % 2880)


def fits_image(pixels, kind, **cards):
    axes = {"NAXIS": pixels.ndim} | {f"NAXIS{axis}": size for axis, size in enumerate(pixels.shape[::-1], 1)}
    start = {"XTENSION": "'IMAGE   '"} if cards.pop("extension", False) else {"SIMPLE": "T"}
    return fits_bytes(start | {"BITPIX": 8 * np.dtype(kind).itemsize} | axes | cards, pixels.astype(kind).tobytes())


def in_fits(path, extension=False):
    image = fits_image(FRAMES.astype(int) - 32768, ">i2", BZERO="3.2768D4", BSCALE=1, extension=extension)
    path.write_bytes((fits_bytes({"SIMPLE": "T", "BITPIX": 8, "NAXIS": 0}) if extension else b"") + image)


def in_spe(path, version=2.5, metadata=b""):
    header = bytearray(4100)
    pixels = b"".join(frame.tobytes() + metadata for frame in FRAMES)
    layout = f'<DataFormat><DataBlock type="Frame" count="5" size="1200" stride="{1200 + len(metadata)}"><DataBlock '
    places = {
        "<H": ((42, 30), (656, 20), (108, 3), (1446, 5)),
        "<f": ((1992, version),),
        "<Q": ((678, 4100 + len(pixels)),),
    }
    for kind, pairs in places.items():
        for place, value in pairs:
            struct.pack_into(kind, header, place, value)
    path.write_bytes(bytes(header) + pixels + f'{layout}type="Region" width="30" height="20"/></DataFormat>'.encode())


def in_lsm(path, frames=FRAMES, positions=0):
    """Images and their coloured previews in turn, as Zeiss writes them."""
    info = np.zeros(1, [(name or f"unused{k}", kind) for k, (name, kind) in enumerate(tifffile.TIFF.CZ_LSMINFO)])
    sizes = {"X": 30, "Y": 20, "Z": 1, "Channels": 1, "Time": len(frames) // max(positions, 1), "P": positions}
    for name, value in {"MagicNumber": 67127628, "StructureSize": info.nbytes, "ScanType": 3}.items():
        info[name] = value
    for name, value in sizes.items():
        info[f"Dimension{name}"] = value
    with tifffile.TiffWriter(path, byteorder="<") as file:
        for number, frame in enumerate(frames):
            tag = [(34412, 1, info.nbytes, info.tobytes(), True)] if number == 0 else []
            file.write(frame, photometric="minisblack", extratags=tag, metadata=None, contiguous=False)
            file.write(
                np.zeros((3, 4, 4), np.uint8), photometric="rgb", planarconfig="separate", subfiletype=1, metadata=None
            )


def in_stk(path, wavelengths=(500,) * 5):
    """One page, all planes behind each other, and the tags of MetaMorph, whose counts are numbers of planes."""
    each = {33629: [0, 1, 0, 0, 0, 0] * 5, 33630: [value for wave in wavelengths for value in (wave, 1)]}
    tags = [(33628, 4, 2, (4, 0), True)] + [(tag, 5, len(values) // 2, values, True) for tag, values in each.items()]
    tifffile.imwrite(
        path, FRAMES, photometric="minisblack", truncate=True, extratags=tags, metadata=None, byteorder="<"
    )
    path.write_bytes(path.read_bytes().replace(struct.pack("<HHI", 33629, 5, 15), struct.pack("<HHI", 33629, 5, 5)))


WRITERS = {
    "a.fits": in_fits,
    "b.fit": lambda path: in_fits(path, extension=True),
    "c.spe": in_spe,
    "c3.spe": lambda path: in_spe(path, version=3.0, metadata=b"time"),
    "d.mat": lambda path: scipy.io.savemat(path, {"frames": np.moveaxis(FRAMES, 0, -1)}),
    "e.raw": lambda path: path.write_bytes(FRAMES.tobytes()),
    "f.bin": lambda path: path.write_bytes(b"some header" + FRAMES.tobytes()),
    "g.stk": in_stk,
    "h.lsm": in_lsm,
}


@pytest.mark.parametrize("name", list(WRITERS))
def test_frames_are_read_unchanged(tmp_path, name):
    WRITERS[name](tmp_path / name)
    member = "::5x20x30:uint16" if name[0] in "ef" else ""
    found = read(f"{tmp_path / name}{member}").data
    assert found.dtype == np.uint16
    assert np.array_equal(found, FRAMES)


def test_every_suffix_has_a_reader():
    assert set(READERS) == FORMATS["camera_formats"] | {PNG_SUFFIX}


@pytest.mark.parametrize(
    ("name", "fix"), [("a.raw", "100x512x512:uint16"), ("b.vsi", "Fiji"), ("c.raw::9x20x30:u2", "shorter")]
)
def test_what_cannot_be_read_names_the_fix(tmp_path, name, fix):
    (tmp_path / name.partition("::")[0]).write_bytes(FRAMES.tobytes())
    with pytest.raises(ValueError, match=fix):
        read(tmp_path / name)


def test_undefined_pixels_are_no_values(tmp_path):
    (tmp_path / "a.fits").write_bytes(fits_image(np.array([[1, -7], [3, 4]]), ">i4", BLANK=-7))
    assert np.array_equal(read(tmp_path / "a.fits").data, [[1, np.nan], [3, 4]], equal_nan=True)


@pytest.mark.parametrize(("kind", "zero", "stored"), [(">i8", 2**63, "uint64"), ("u1", -128, "int8")])
def test_integers_of_the_other_sign_keep_all_digits(tmp_path, kind, zero, stored):
    values = np.array([[0, 1], [2, np.iinfo(stored).max]], stored)
    raw = (values.astype(object) - zero).astype(kind)
    (tmp_path / "a.fits").write_bytes(fits_image(raw, kind, BZERO=zero))
    assert np.array_equal(read(tmp_path / "a.fits").data, values)


def test_images_of_equal_names_are_chosen_by_number(tmp_path):
    images = [fits_image(FRAMES[k].astype(int), ">i4", EXTNAME="'SCI'", extension=k > 0) for k in range(2)]
    (tmp_path / "a.fits").write_bytes(b"".join(images))
    with pytest.raises(SeveralImages, match="'0', '1'"):
        read(tmp_path / "a.fits")
    assert np.array_equal(read(f"{tmp_path / 'a.fits'}::1").data, FRAMES[1])


def test_channels_of_matlab_files_are_chosen(tmp_path):
    scipy.io.savemat(
        tmp_path / "a.mat", {"movie": np.stack([FRAMES, FRAMES + 1]).transpose(2, 3, 0, 1), "time": np.arange(9.0)}
    )
    with pytest.raises(SeveralImages):
        read(tmp_path / "a.mat")
    assert np.array_equal(read(f"{tmp_path / 'a.mat'}::1").data, FRAMES + 1)


def test_skipped_frames_of_raw_files_are_named(tmp_path):
    (tmp_path / "a.raw").write_bytes(FRAMES.tobytes())
    with pytest.warns(UserWarning, match="3 frames"):
        assert np.array_equal(read(f"{tmp_path / 'a.raw'}::2x20x30:uint16").data, FRAMES[3:])


def test_wavelengths_and_positions_are_no_frames(tmp_path):
    in_stk(tmp_path / "a.stk", wavelengths=(488, 561, 488, 561, 488))
    in_lsm(tmp_path / "b.lsm", frames=FRAMES[:4], positions=2)
    for name, chosen in (("a.stk::561", FRAMES[1::2]), ("b.lsm::1", FRAMES[2:4])):
        with pytest.raises(SeveralImages):
            read(tmp_path / name.partition("::")[0])
        assert np.array_equal(read(tmp_path / name).data, chosen)


def test_axes_with_names_are_arranged():
    data = np.arange(2 * 5 * 3 * 4 * 6).reshape(2, 1, 5, 3, 4, 6)
    found = by_axes(data, "PZTCYX", ["red", "green", "blue"], member="1")
    assert found.named
    assert found.channels == ("red", "green", "blue")
    assert np.array_equal(found.data, data[1, 0].swapaxes(0, 1))
    for axes, word in (("PZTCYX", "positions"), ("SZTCYX", "colour")):
        with pytest.raises(ValueError, match=word):
            by_axes(data, axes)


def test_positions_are_chosen_and_never_dropped(tmp_path):
    path = tmp_path / "positions.ome.tif"
    with tifffile.TiffWriter(path, ome=True) as file:
        for number in range(2):
            file.write(FRAMES + number, photometric="minisblack", metadata={"axes": "TYX", "Name": f"site {number}"})
    with pytest.raises(SeveralImages, match="site 0"):
        read(path)
    assert np.array_equal(read(f"{path}::site 1").data, FRAMES + 1)
    assert np.array_equal(read(path, channel=0).data, FRAMES)


def test_frames_along_the_last_axis_are_recognised(tmp_path):
    generator = np.random.default_rng(1)
    scene = np.add.outer(np.arange(40.0), 3 * np.arange(60.0))
    frames = scene + generator.normal(0, 1, (8, 40, 60))
    for stored in (frames, np.moveaxis(frames, 0, -1)):
        np.save(tmp_path / "frames.npy", stored)
        assert np.array_equal(frames_of(tmp_path / "frames.npy")[0], frames)
