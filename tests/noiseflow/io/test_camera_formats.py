"""Frames of cameras, written byte by byte as their formats say, are read unchanged."""

import numpy as np
import pytest
import scipy.io
import tifffile

from calibration.exposures.reading import frames_of
from noiseflow.io import read
from noiseflow.io.camera_formats import READERS
from noiseflow.io.checks import SeveralImages
from noiseflow.io.image_file import FORMATS, PNG_SUFFIX

FRAMES = np.random.default_rng(0).integers(0, 60_000, (5, 20, 30)).astype(np.uint16)


def fits_bytes(cards, data=b""):
    header = "".join(f"{name:8s}= {value:>20}".ljust(80) for name, value in cards.items()) + "END".ljust(80)
    pad = -len(header) % 2880
    return (header + pad * " ").encode() + data + b"\0" * (-len(data) % 2880)


def in_fits(path, extension=False):
    axes = {"NAXIS": 3, "NAXIS1": 30, "NAXIS2": 20, "NAXIS3": 5, "BZERO": 32768, "BSCALE": 1}
    data = (FRAMES.astype(int) - 32768).astype(">i2").tobytes()
    first = fits_bytes({"SIMPLE": "T", "BITPIX": 8, "NAXIS": 0}) if extension else b""
    kind = {"XTENSION": "'IMAGE   '"} if extension else {"SIMPLE": "T"}
    path.write_bytes(first + fits_bytes(kind | {"BITPIX": 16} | axes, data))


def in_spe(path):
    header = bytearray(4100)
    for place, value in ((42, 30), (656, 20), (108, 3), (1446, 5)):
        header[place : place + 2] = value.to_bytes(2, "little")
    path.write_bytes(bytes(header) + FRAMES.tobytes())


WRITERS = {
    "a.fits": in_fits,
    "b.fit": lambda path: in_fits(path, extension=True),
    "c.spe": in_spe,
    "d.mat": lambda path: scipy.io.savemat(path, {"frames": np.moveaxis(FRAMES, 0, -1)}),
    "e.raw": lambda path: path.write_bytes(FRAMES.tobytes()),
    "f.bin": lambda path: path.write_bytes(b"some header" + FRAMES.tobytes()),
    "g.stk": lambda path: tifffile.imwrite(path, FRAMES, photometric="minisblack"),
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
