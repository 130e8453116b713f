"""Every row of the tables of files in the guide: such a file is written, opened, and gives the right images and angles."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile

import recon
from noiseflow import io
from tests.test_formats import ANGLES, PIXEL, SHAPE, WRITERS, images

GUIDE = Path(__file__).parents[1] / "docs" / "guide" / "files.md"
ROWS = re.findall(r"^\| `([^`]+)` \|.*\| (?:yes|no) \|$", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)
COUNTS = images().astype("u2")
SHUFFLED = np.random.default_rng(0).permutation(len(ANGLES))
CHANNEL = {"ImageJ hyperstack": 1, "OME-TIFF with channels": "Fe", "HDF5 with maps": 1}


def _mrc(path: Path, data: np.ndarray, **header: Any) -> Path:
    with mrcfile.new(path, data=data) as stack:
        stack.voxel_size = PIXEL
        for name, value in header.items():
            stack.header[name] = value
    return path


def _angles(path: Path) -> None:
    np.savetxt(path, ANGLES, fmt="%.2f")


def mrc_with(name: str, text: Callable[[], str], suffix: str = ".mrc") -> Callable[[Path], Path]:
    """A stack of the given suffix with a text file beside it."""

    def write(folder: Path) -> Path:
        (folder / name).write_text(text(), encoding="utf-8")
        return _mrc(folder / f"series{suffix}", COUNTS)

    return write


def _lines(row: str, end: str = "\n") -> Callable[[], str]:
    return lambda: "".join(row.format(number=n + 1, angle=angle) + end for n, angle in enumerate(ANGLES))


def _decimal_commas() -> str:
    return "".join(f"{angle:.1f}\n".replace(".", ",") for angle in ANGLES)


def _star(prefix: str, names: list[str], order: Any = None) -> str:
    angles = ANGLES if order is None else ANGLES[order]
    relion = "MicrographMovieName TomoTiltMovieFrameCount TomoNominalStageTiltAngle TomoNominalTiltAxisAngle"
    warp = "MovieName Dose AngleTilt AxisAngle AverageIntensity MaskedFraction"
    columns = f"{relion} MicrographPreExposure TomoNominalDefocus" if prefix == "rln" else warp
    titles = "".join(f"_{prefix}{name} #{number}\n" for number, name in enumerate(columns.split(), 1))
    rows = "".join(f"frames/{name} 8 {a} 0.000 3.0 -4.0\n" for name, a in zip(names, angles, strict=True))
    return f"\n# version 50001\n\ndata_{'TS_01' if prefix == 'rln' else ''}\n\nloop_\n{titles}{rows}\n"


def _aln() -> str:
    row = "{:5d}     0.0000    1.00000      0.000      0.000     1.00     1.00     1.00     0.00  {:8.2f}\n"
    rows = "".join(row.format(number, angle) for number, angle in enumerate(ANGLES, 1))
    size = f"# RawSize = {SHAPE[2]} {SHAPE[1]} {SHAPE[0]}\n# NumPatches = 0\n# AlphaOffset =     0.00\n"
    titles = (
        "# BetaOffset =     0.00\n# Thickness = 8\n# SEC     ROT         GMAG       TX          TY      SMEAN     SFIT"
    )
    return f"# AreTomo Alignment / Priims bprmMn\n{size}{titles}    SCALE     BASE     TILT\n{rows}"


def folder_of(kind: str) -> Callable[[Path], Path]:
    """A folder of images whose names say nothing of the order, and what joins them to angles."""

    def write(folder: Path) -> Path:
        folder = folder / "series"
        folder.mkdir()
        names = [f"{letter}{k}" for k, letter in zip(SHUFFLED, "qwertyuiopasd", strict=True)]
        for name, image, angle in zip(names, COUNTS, ANGLES, strict=True):
            pixels = np.stack([image // 2, image - image // 2]) if "movies" in kind else image
            tifffile.imwrite(folder / f"{name}.tif", pixels, photometric="minisblack")
            if "each" in kind:
                text = f"PixelSpacing = {PIXEL}\n[FrameSet = 0]\nTiltAngle = {angle}\n"
                (folder / f"{name}.tif.mdoc").write_text(text)
        rows = list(zip(SHUFFLED, names, ANGLES, strict=True))
        sections = [f"[Image = {name}.tif]\nTiltAngle = {angle}\n" for _, name, angle in rows]
        paths = [f"[ZValue = {k}]\nTiltAngle = {a}\nSubFramePath = X:\\m\\{name}.eer\n" for k, name, a in rows]
        text = {
            "one mdoc": ("all.mdoc", f"PixelSpacing = {PIXEL}\n\n{''.join(sections)}"),
            "movies, one mdoc": ("all.mdoc", f"PixelSpacing = {PIXEL}\n\n{''.join(paths)}"),
            "names": ("all.tlt", "".join(f"{name}.tif {angle}\n" for _, name, angle in sorted(rows))),
            "star": ("all.star", _star("rln", [f"{name}.eer" for name in np.array(names)[SHUFFLED]], SHUFFLED)),
            "tomostar": ("all.tomostar", _star("wrp", [f"{name}.eer" for name in np.array(names)[SHUFFLED]], SHUFFLED)),
        }.get(kind)
        if text is not None:
            (folder / text[0]).write_text(text[1])
        return folder

    return write


def png_images(folder: Path) -> Path:
    from PIL import Image

    folder = folder / "series"
    folder.mkdir()
    for angle, image in zip(ANGLES, COUNTS, strict=True):
        Image.fromarray(image).save(folder / f"tilt_{angle:+.1f}.png")
    return folder


def imod_bytes(folder: Path) -> Path:
    extra = np.zeros(84, "u1")
    extra[40:48] = np.array([1146047817, 1], "<i4").view("u1")
    _angles(folder / "series.rawtlt")
    return _mrc(folder / "series.mrc", (COUNTS.astype("i2") - 128).astype("i1"), extra2=extra.tobytes())


def packed(folder: Path) -> Path:
    _angles(folder / "series.rawtlt")
    plain = _mrc(folder / "series.mrc", COUNTS)
    (folder / "series.mrc.gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    return folder / "series.mrc.gz"


def tiff(**options: Any) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        data = 65535 - COUNTS if options.get("photometric") == "miniswhite" else COUNTS
        _angles(folder / "series.rawtlt")
        tifffile.imwrite(folder / "series.tif", data, **{"photometric": "minisblack"} | options)
        return folder / "series.tif"

    return write


def hyperstack(folder: Path) -> Path:
    both = np.stack([COUNTS // 3, COUNTS], 1)
    metadata = {"axes": "ZCYX", "unit": "nm"}
    tifffile.imwrite(folder / "series.tif", both, imagej=True, resolution=(10 / PIXEL,) * 2, metadata=metadata)
    _angles(folder / "series.rawtlt")
    return folder / "series.tif"


def ome_channels(folder: Path) -> Path:
    sizes = {f"PhysicalSize{axis}": PIXEL / 10 for axis in "XY"} | {f"PhysicalSize{axis}Unit": "nm" for axis in "XY"}
    metadata = {"axes": "CZYX", "Channel": {"Name": ["HAADF", "Fe"]}, **sizes}
    tifffile.imwrite(folder / "series.ome.tif", np.stack([COUNTS // 3, COUNTS]), metadata=metadata)
    _angles(folder / "series.ome.rawtlt")
    return folder / "series.ome.tif"


def nxtomo(folder: Path) -> Path:
    flat, dark = np.full(SHAPE[1:], 500.0), np.full(SHAPE[1:], 20.0)
    frames = [dark, flat, *(20 + 480 * COUNTS / 1000), flat, np.full(SHAPE[1:], 9.0)]
    with h5py.File(folder / "series.nxs", "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = np.stack(frames).astype("f4")
        detector["image_key"] = [2, 1, *([0] * len(ANGLES)), 1, 3]
        detector["x_pixel_size"] = detector["y_pixel_size"] = PIXEL * 1e-10
        for name in "xy":
            detector[f"{name}_pixel_size"].attrs["units"] = "m"
        file["entry/sample/rotation_angle"] = np.deg2rad([0, 0, *ANGLES, 0, 0])
        file["entry/sample/rotation_angle"].attrs["units"] = "rad"
    return folder / "series.nxs"


def data_exchange(folder: Path) -> Path:
    with h5py.File(folder / "series.h5", "w") as file:
        file["exchange/data"] = (20 + 480 * COUNTS / 1000).astype("f4")
        file["exchange/data_white"], file["exchange/data_dark"] = (
            np.full((2, *SHAPE[1:]), 500.0),
            np.full((3, *SHAPE[1:]), 20.0),
        )
        file["exchange/theta"] = ANGLES
    return folder / "series.h5"


def maps(folder: Path) -> Path:
    with h5py.File(folder / "series.hdf", "w") as file:
        file["maps"], file["tilt"] = np.stack([COUNTS // 3, COUNTS]), ANGLES
    return folder / "series.hdf"


def tilts_last(folder: Path) -> Path:
    with h5py.File(folder / "series.h5", "w") as file:
        file["scan/images"], file["scan/alpha"] = np.moveaxis(COUNTS, 0, -1), ANGLES
    return folder / "series.h5"


def plain_zarr(folder: Path) -> Path:
    import zarr

    group = zarr.open_group(folder / "series.zarr", mode="w")
    group.create_array("raw/preview", data=COUNTS[:, ::2, ::2])
    group.create_array("raw/images", data=COUNTS, attributes={"tilt_angles": ANGLES.tolist()})
    return folder / "series.zarr"


def tilt_com(folder: Path) -> Path:
    path = _mrc(folder / "series_ali.mrc", COUNTS)
    np.savetxt(folder / "series.tlt", ANGLES - 2.5, fmt="%.2f")
    (folder / "tilt.com").write_text("$tilt\nInputProjections series_ali.mrc\nTILTFILE series.tlt\nOFFSET 2.5\n")
    return path


MORE: dict[str, Callable[[Path], Path]] = {
    "MRC bytes of IMOD": imod_bytes,
    "MRC packed": packed,
    ".preali": mrc_with("series.rawtlt", _lines("{angle}"), ".preali"),
    "TIFF in centimetres": tiff(resolution=(1e8 / PIXEL,) * 2, resolutionunit="CENTIMETER"),
    "MINISWHITE TIFF": tiff(photometric="miniswhite"),
    "ImageJ hyperstack": hyperstack,
    "OME-TIFF with channels": ome_channels,
    "NXtomo": nxtomo,
    "Data Exchange": data_exchange,
    "HDF5 with maps": maps,
    "HDF5 with tilts last": tilts_last,
    "Zarr": plain_zarr,
    "PNG images": png_images,
    "images, one mdoc": folder_of("one mdoc"),
    "images, one mdoc each": folder_of("each"),
    "movies, one mdoc": folder_of("movies, one mdoc"),
    "movies, one mdoc each": folder_of("movies, each"),
    "images, list of names": folder_of("names"),
    "images, RELION table": folder_of("star"),
    "images, Warp table": folder_of("tomostar"),
    "list": mrc_with("series.rawtlt", _lines("{angle}")),
    "list with comments": mrc_with("series.tlt", _lines("{angle}  # view {number}")),
    "list in one line": mrc_with("series.tlt", _lines("{angle}", " ")),
    "list with decimal commas": mrc_with("series.tlt", _decimal_commas),
    "table of angles and dose": mrc_with("series.tlt", _lines("{angle} {number}.5")),
    "numbered list": mrc_with("series.tlt", _lines("{number} {angle}")),
    "mdoc of a stack": mrc_with("series.mrc.mdoc", _lines("[ZValue = {number}]\nTiltAngle = {angle}")),
    "mdoc in lower case": mrc_with("series.mdoc", _lines("[zvalue={number}]\ntiltangle={angle}")),
    "AreTomo": mrc_with("series.aln", _aln),
    "RELION": mrc_with("series.star", lambda: _star("rln", [f"{k}.tif" for k in range(len(ANGLES))])),
    "Warp": mrc_with("series.tomostar", lambda: _star("wrp", [f"{k}.tif" for k in range(len(ANGLES))])),
    "tilt.com": tilt_com,
}


def test_the_guide_and_the_tests_have_the_same_rows() -> None:
    assert sorted(ROWS) == sorted({**WRITERS, **MORE})
    assert len(set(ROWS)) == len(ROWS)


@pytest.mark.filterwarnings(
    "ignore:.*(columns|becomes the first|frames|flat and dark|MINISWHITE|adds 2.5|Parsing|units could)"
)
@pytest.mark.parametrize("row", ROWS)
def test_every_row_of_the_guide_opens_with_each_image_at_its_angle(row: str, tmp_path: Path) -> None:
    path = {**WRITERS, **MORE}[row](tmp_path)
    series = recon.read_tilt_series(path, channel=CHANNEL.get(row))
    order = np.argsort(series.tilt_angles)
    np.testing.assert_allclose(series.tilt_angles[order], ANGLES, atol=0.01)
    expected = images()[:, ::-1] if row == "folder_of_ser" else images()  # TIA counts rows from the bottom
    expected = COUNTS / 1000 if row in ("NXtomo", "Data Exchange") else expected
    # formats with whole numbers drop decimals
    np.testing.assert_allclose(series.images[order], expected, atol=1.0, rtol=2e-3)
    text = GUIDE.read_text(encoding="utf-8")
    stated = re.search(rf"^\| `{re.escape(row)}` \|.*\| (yes|no) \|$", text, re.MULTILINE)
    assert stated is not None
    known = None if series.pixel_size is None else pytest.approx(PIXEL, rel=1e-4)
    assert known == series.pixel_size
    assert (series.pixel_size is not None) == (stated[1] == "yes")


@pytest.mark.parametrize("beside", ["series.tlt", "series.ome.tlt"])
def test_angles_beside_ome_files_may_have_the_name_without_ome(beside: str, tmp_path: Path) -> None:
    io.write(tmp_path / "series.ome.zarr", COUNTS)
    _angles(tmp_path / beside)
    np.testing.assert_array_equal(recon.read_tilt_series(tmp_path / "series.ome.zarr").tilt_angles, ANGLES)


def test_angles_in_radians_without_a_unit_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "series.npz", images=COUNTS, tilt_angles=np.deg2rad(ANGLES))
    with pytest.warns(UserWarning, match="tilt_angles seems to hold radians"), pytest.raises(FileNotFoundError):
        recon.read_tilt_series(tmp_path / "series.npz")


def test_the_guide_writes_what_it_reads(tmp_path: Path) -> None:
    series = recon.TiltSeries(images(), ANGLES, PIXEL, "transmission")
    recon.write_tilt_series(tmp_path / "a.mrc", series)
    np.testing.assert_array_equal(io.read(tmp_path / "a.mrc").data, images().astype("f4"))
