"""Tilt series of every format, written by another library, through the command: angles and voxel sizes arrive in the volume."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile

from noiseflow import io
from recon.verdict import judge

ANGLES = np.arange(-60, 61, 10.0)
PIXEL = 8.0
SHAPE = (len(ANGLES), 12, 16)
NEEDLE = Path(__file__).parents[2] / "shared" / "data" / "tilt_needle" / "needle_raw.dm3"


def images() -> np.ndarray:
    """A bright-field series of a rod along the axis, 50 … 250."""
    u = np.arange(SHAPE[2]) - 7.5
    centre = 3 * np.cos(np.deg2rad(ANGLES))[:, None, None]
    chord = np.sqrt(np.clip(9 - (u - centre) ** 2, 0, None)) * np.ones((1, SHAPE[1], 1))
    return 50 + 70 * np.exp(-0.2 * chord) + np.random.default_rng(0).normal(size=SHAPE)


def _mrc(path: Path, dtype: str = "f4", **header: Any) -> None:
    with mrcfile.new(path, data=images().astype(dtype)) as stack:
        stack.voxel_size = PIXEL
        for name, value in header.items():
            stack.header[name] = value


def _angles_beside(path: Path) -> None:
    np.savetxt(path.with_suffix(".rawtlt"), ANGLES, fmt="%.2f")


def mrc_of_type(dtype: str, suffix: str = ".mrc", beside: str = ".rawtlt") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / f"series{suffix}"
        _mrc(path, dtype)
        np.savetxt(path.with_suffix(beside), ANGLES, fmt="%.2f")
        return path

    return write


def big_endian_mrc(folder: Path) -> Path:
    with mrcfile.new(folder / "series.mrc", data=images().astype(">f4")) as stack:
        stack.voxel_size = PIXEL
    _angles_beside(folder / "series.mrc")
    return folder / "series.mrc"


def mdoc(folder: Path) -> Path:
    _mrc(folder / "series.st", "i2")
    sections = "".join(f"[ZValue = {n}]\nTiltAngle = {a}\n\n" for n, a in enumerate(ANGLES))
    (folder / "series.st.mdoc").write_text(f"PixelSpacing = {PIXEL}\nImageFile = series.st\n\n{sections}")
    return folder / "series.st"


def serialem(folder: Path) -> Path:
    with mrcfile.new(folder / "series.st", data=images().astype("f4")) as stack:
        stack.voxel_size = PIXEL
        stack.set_extended_header(np.frombuffer((ANGLES * 100).astype("<i2").tobytes(), "V1"))
        stack.header.extra2 = b"\0" * 16 + struct.pack("<2h", 2, 1) + stack.header.extra2.tobytes()[20:]
        stack.header.exttyp = b"SERI"
    return folder / "series.st"


def fei(folder: Path) -> Path:
    records = np.zeros(len(ANGLES), mrcfile.dtypes.get_ext_header_dtype(b"FEI1"))
    records["Metadata size"] = records.dtype.itemsize
    records["Alpha tilt"] = ANGLES
    with mrcfile.new(folder / "series.mrc", data=images().astype("i2")) as stack:
        stack.voxel_size = PIXEL
        stack.set_extended_header(records)
        stack.header.exttyp = b"FEI1"
    return folder / "series.mrc"


def ome_tiff(folder: Path) -> Path:
    metadata = {"axes": "ZYX", "PhysicalSizeX": PIXEL / 10, "PhysicalSizeXUnit": "nm"}
    metadata |= {"PhysicalSizeY": PIXEL / 10, "PhysicalSizeYUnit": "nm"}
    tifffile.imwrite(folder / "series.ome.tif", images().astype("u2"), ome=True, metadata=metadata)
    np.savetxt(folder / "series.ome.rawtlt", ANGLES)
    return folder / "series.ome.tif"


def imagej_tiff(folder: Path) -> Path:
    options = {"imagej": True, "resolution": (10 / PIXEL, 10 / PIXEL), "metadata": {"unit": "nm", "axes": "ZYX"}}
    tifffile.imwrite(folder / "series.tif", images().astype("f4"), **options)
    _angles_beside(folder / "series.tif")
    return folder / "series.tif"


def folder_with_angles_in_names(folder: Path) -> Path:
    (folder / "series").mkdir()
    for angle, image in zip(ANGLES, images(), strict=True):
        options = {"imagej": True, "resolution": (10 / PIXEL, 10 / PIXEL), "metadata": {"unit": "nm"}}
        tifffile.imwrite(folder / "series" / f"cell_{angle:+.1f}.tif", image.astype("f4"), **options)
    return folder / "series"


def folder_with_angle_file(folder: Path) -> Path:
    (folder / "series").mkdir()
    for number, image in enumerate(images()):
        options = {"imagej": True, "resolution": (10 / PIXEL, 10 / PIXEL), "metadata": {"unit": "nm"}}
        tifffile.imwrite(folder / "series" / f"image{number}.tif", image.astype("f4"), **options)
    np.savetxt(folder / "series" / "angles.tlt", ANGLES)
    return folder / "series"


def velox_emd(folder: Path) -> Path:
    """As Velox writes it: (y, x, section), and one JSON text of metadata per section."""
    import json

    with h5py.File(folder / "series.emd", "w") as file:
        group = file.create_group("Data/Image/0123456789abcdef0123456789abcdef")
        group.create_dataset("Data", data=images().astype("u2").transpose(1, 2, 0), chunks=(*SHAPE[1:], 1))
        texts = []
        for angle in ANGLES:
            size = {"width": str(PIXEL * 1e-10), "height": str(PIXEL * 1e-10)}
            text = {
                "BinaryResult": {
                    "PixelSize": size,
                    "PixelUnitX": "m",
                    "PixelUnitY": "m",
                    "Offset": {"x": "0", "y": "0"},
                    "Detector": "HAADF",
                },
                "Detectors": {"Detector-0": {"DetectorName": "HAADF", "DetectorType": "ScanningDetector"}},
                "Stage": {"AlphaTilt": str(np.deg2rad(angle)), "BetaTilt": "0"},
                "Core": {"MetadataDefinitionVersion": "7.9", "guid": "0"},
                "Instrument": {"InstrumentClass": "Titan"},
                "Optics": {"AccelerationVoltage": "300000"},
                "Acquisition": {"AcquisitionStartDatetime": {"DateTime": "1600000000"}},
                "CustomProperties": {},
                "Scan": {"DwellTime": "1e-6", "FrameTime": "1"},
                "Operations": {},
                "Features": {},
            }
            texts.append(np.frombuffer(json.dumps(text).encode().ljust(4000, b"\0"), "u1"))
        group["Metadata"] = np.stack(texts, axis=1)
        group.create_dataset("FrameLookupTable", data=np.arange(len(ANGLES)))
        file.create_group("Info")
        file["Version"] = np.array([b'{"format": "Velox", "version": "1.9"}'])
    return folder / "series.emd"


def ncem_emd(folder: Path, order: Sequence[int] = (0, 1, 2)) -> Path:
    with h5py.File(folder / "series.emd", "w") as file:
        file.attrs["version_major"], file.attrs["version_minor"] = 0, 2
        group = file.create_group("data/series")
        group.attrs["emd_group_type"] = 1
        group["data"] = images().astype("f4").transpose(order)
        lengths = [
            (ANGLES, "tilt", "deg"),
            *((np.arange(n) * PIXEL / 10, a, "n_m") for n, a in zip(SHAPE[1:], "yx", strict=True)),
        ]
        for number, (values, name, unit) in enumerate((lengths[place] for place in order), 1):
            group[f"dim{number}"] = values
            group[f"dim{number}"].attrs["name"] = name
            group[f"dim{number}"].attrs["units"] = f"[{unit}]"
    return folder / "series.emd"


def ncem_emd_with_tilts_last(folder: Path) -> Path:
    return ncem_emd(folder, (1, 2, 0))


def nexus(folder: Path) -> Path:
    with h5py.File(folder / "series.nxs", "w") as file:
        file["entry/data/data"] = images().astype("f4")
        file["entry/data/data"].attrs["element_size_um"] = [PIXEL * 1e-4] * 3
        file["entry/sample/rotation_angle"] = ANGLES
        file["entry/sample/rotation_angle"].attrs["units"] = "degree"
    return folder / "series.nxs"


def hspy(folder: Path) -> Path:
    from rsciio.hspy import file_writer

    from tests.noiseflow.io.test_microscope import signal

    rows = [("tilt", "deg", 10.0, -60.0), ("y", "nm", PIXEL / 10, 0.0), ("x", "nm", PIXEL / 10, 0.0)]
    names = ("name", "units", "scale", "offset")
    axes = [
        dict(zip(names, row, strict=True)) | {"size": size, "index_in_array": number, "navigate": number == 0}
        for number, (row, size) in enumerate(zip(rows, SHAPE, strict=True))
    ]
    file_writer(str(folder / "series.hspy"), signal(images(), axes=axes))
    return folder / "series.hspy"


def folder_of_ser(folder: Path) -> Path:
    from tests.noiseflow.io.test_microscope import write_ser

    (folder / "series").mkdir()
    for angle, image in zip(ANGLES, images(), strict=True):
        write_ser(folder / "series" / f"tilt_{angle:.1f}.ser", image.astype("u2"), PIXEL * 1e-10)
    return folder / "series"


def ome_zarr(folder: Path) -> Path:
    io.write(folder / "series.zarr", images().astype("f4"), voxel_size=(PIXEL,) * 3)
    _angles_beside(folder / "series.zarr")
    return folder / "series.zarr"


def numpy_file(folder: Path) -> Path:
    np.save(folder / "series.npy", images())
    np.savetxt(folder / "series.tlt", ANGLES)
    return folder / "series.npy"


def numpy_archive(folder: Path) -> Path:
    np.savez(folder / "series.npz", images=images(), tilt_angles=ANGLES)
    return folder / "series.npz"


WRITERS = {
    **{f"mrc {dtype}": mrc_of_type(dtype) for dtype in ("i1", "i2", "u2", "f2", "f4")},
    **{suffix: mrc_of_type("f4", suffix, ".tlt") for suffix in (".st", ".ali", ".rec", ".mrcs")},
}
WRITERS |= {
    function.__name__: function
    for function in (
        *(
            big_endian_mrc,
            mdoc,
            serialem,
            fei,
            ome_tiff,
            imagej_tiff,
            folder_with_angles_in_names,
            folder_with_angle_file,
        ),
        *(
            velox_emd,
            ncem_emd,
            ncem_emd_with_tilts_last,
            nexus,
            hspy,
            folder_of_ser,
            ome_zarr,
            numpy_file,
            numpy_archive,
        ),
    )
}


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the checks of the volume, which know of no format."""
    monkeypatch.setattr(judge, "CHECKS", {})


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", WRITERS)
def test_angles_and_voxel_size_arrive_in_the_volume(name: str, tmp_path: Path, run) -> None:
    source = tmp_path / "in"
    source.mkdir()
    path = WRITERS[name](source)
    options = ["--method", "wbp", "--window", "hann", "--keep-tilts"]
    result = run("reconstruct", path, "-o", tmp_path / "volume.mrc", *options)
    assert result["figures"]["tilts"] == "13, -60° to 60°"
    with mrcfile.open(tmp_path / "volume.mrc") as volume:
        assert volume.data.shape == (16, 12, 16)
        rod = np.argwhere(volume.data > 0.5 * volume.data.max()).mean(0)
        np.testing.assert_allclose(rod[[0, 2]], [7.5, 10.5], atol=0.7)
        if not name.startswith("numpy"):
            assert float(volume.voxel_size.z) == pytest.approx(PIXEL, rel=1e-5)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "volume.mrc", "volume.mrc.options.toml"]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("suffix", [".mrc", ".rec", ".tif", ".npy", ".zarr"])
def test_every_output_carries_the_voxel_size(suffix: str, tmp_path: Path, run) -> None:
    path = mrc_of_type("f4")(tmp_path)
    run("reconstruct", path, "-o", tmp_path / f"volume{suffix}", "--method", "wbp", "--keep-tilts")
    volume = io.read(tmp_path / f"volume{suffix}")
    assert volume.data.shape == (16, 12, 16)
    assert volume.voxel_size == (None if suffix == ".npy" else pytest.approx((PIXEL,) * 3, rel=1e-5))


def test_transforms_are_applied_on_request(tmp_path: Path, run) -> None:
    path = mrc_of_type("f4", ".st")(tmp_path)
    (tmp_path / "series.xf").write_text("1 0 0 1 2 0\n" * len(ANGLES))
    run(
        "reconstruct",
        path,
        "--alignment",
        tmp_path / "series.xf",
        "-o",
        tmp_path / "v.mrc",
        "--method",
        "wbp",
        "--keep-tilts",
    )
    volume = io.read(tmp_path / "v.mrc").data
    assert np.argwhere(volume > 0.5 * volume.max()).mean(0)[2] == pytest.approx(12.5, abs=0.9)


@pytest.mark.skipif(not NEEDLE.exists(), reason="the raw needle series is not here")
def test_dm3_goes_in_with_nothing_else(tmp_path: Path, run) -> None:
    shutil.copy(NEEDLE, tmp_path / "my needle.dm3")
    result = run(
        "reconstruct", tmp_path / "my needle.dm3", "-o", tmp_path / "v.mrc", "--mode", "linear", "--method", "wbp"
    )
    assert result["figures"]["tilts"] == "91, -90° to 90°"
    assert io.read(tmp_path / "v.mrc").voxel_size == pytest.approx((179.949,) * 3, rel=1e-4)
