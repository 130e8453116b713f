"""Damaged files of every format: a reader gives an image or one ValueError, in bounded memory and time.

``make fuzz`` runs many more examples than CI does; NOISEFLOW_FUZZ_EXAMPLES says how many of each kind.
"""

from __future__ import annotations

import os
import resource
import signal
import struct
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import noiseflow
from noiseflow import io
from tests.test_formats import velox_emd

EXAMPLES = int(os.environ.get("NOISEFLOW_FUZZ_EXAMPLES", "60"))
SPARE_MEMORY = 600 * 2**20
SECONDS = 10
STACK = (np.arange(3 * 16 * 20) % 251).reshape(3, 16, 20)
NEEDLE = Path(__file__).parents[3] / "shared" / "data" / "tilt_needle" / "needle_raw.dm3"

fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
numbers = st.sampled_from([0, 1, 2, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1])
spots = st.floats(0, 1, exclude_max=True)
near_start = spots.map(lambda spot: spot**3)  # headers sit in front
damage = st.one_of(
    st.tuples(st.just("cut"), spots, st.just(0)),
    st.tuples(st.just("byte"), st.one_of(spots, near_start), st.integers(0, 255)),
    st.tuples(st.just("word"), st.one_of(spots, near_start), numbers),
    st.tuples(st.just("drop"), st.one_of(spots, near_start), st.integers(1, 64)),
    st.tuples(st.just("double"), st.one_of(spots, near_start), st.integers(1, 64)),
)


def apply(content: bytes, wounds: list[tuple[str, float, int]]) -> bytes:
    for kind, spot, value in wounds:
        at = int(spot * len(content))
        if kind == "cut":
            content = content[:at]
        elif kind == "byte":
            content = content[:at] + bytes([value]) + content[at + 1 :]
        elif kind == "word":
            content = content[:at] + struct.pack("<I", value) + content[at + 4 :]
        elif kind == "drop":
            content = content[:at] + content[at + value :]
        else:
            content = content[: at + value] + content[at:]
    return content


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A small sound file of every kind, by suffix."""
    folder = tmp_path_factory.mktemp("sound")
    for name in ("a.mrc", "a.npy"):
        io.write(folder / name, STACK.astype(np.float32))
    np.savez_compressed(folder / "a.npz", images=STACK, tilt_angles=np.arange(3.0))
    tifffile.imwrite(folder / "a.tif", STACK.astype(np.uint16), photometric="minisblack", compression="zlib")
    tifffile.imwrite(folder / "a.tiff", STACK.astype(np.uint16), ome=True, metadata={"axes": "ZYX"})
    Image.fromarray(STACK[0].astype(np.uint16)).save(folder / "a.png")
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("exchange/data", data=STACK.astype(np.float32), chunks=(1, 16, 20), compression="gzip")
        file["exchange/theta"] = np.arange(3.0)
    noiseflow.save(noiseflow.RadialFlow(2), folder / "a.safetensors")
    velox_emd(folder)
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(autouse=True)
def bounds() -> Iterator[None]:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + SPARE_MEMORY, hard))
    signal.signal(signal.SIGPROF, _give_up)
    yield
    signal.setitimer(signal.ITIMER_PROF, 0)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _give_up(*_: object) -> None:
    pytest.fail(f"still reading after {SECONDS} s")


def read(path: Path, content: bytes) -> torch.nn.Module | io.ImageFile | str:
    """What a reader makes of a file, or the message with which it refuses it."""
    path.write_bytes(content)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        return noiseflow.load(path) if path.suffix == ".safetensors" else io.read(path)
    except ValueError as error:
        return str(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def faults(found: torch.nn.Module | io.ImageFile | str, path: Path) -> list[str]:
    """What is wrong with an answer: a refusal is one line that names the file, a noise model has a distribution, an image is of
    numbers and has as many angles as sections."""
    if isinstance(found, str):
        wrong = {"names no file": str(path) not in found, "several lines": "\n" in found}
    elif isinstance(found, torch.nn.Module):
        wrong = {"no distribution": found(torch.ones(2)).batch_shape != (2,)}
    else:
        sections = len(found.data) if found.data.ndim == 3 else 1
        wrong = {
            "no numbers": found.data.dtype.kind not in "iuf",
            "no image": found.data.ndim not in (2, 3) or found.data.size == 0,
            "angles": found.tilt_angles is not None and len(found.tilt_angles) != sections,
            "voxel size": found.voxel_size is not None and not all(0 < edge < np.inf for edge in found.voxel_size),
        }
    return [fault for fault, there in wrong.items() if there]


@pytest.mark.parametrize("suffix", [".mrc", ".npy", ".npz", ".png", ".tif", ".tiff", ".h5", ".safetensors"])
def test_the_files_are_sound_before_they_are_damaged(suffix: str, sound: dict[str, bytes], tmp_path: Path) -> None:
    found = read(tmp_path / f"a{suffix}", sound[suffix])
    if suffix == ".safetensors":
        assert isinstance(found, noiseflow.RadialFlow)
    else:
        assert isinstance(found, io.ImageFile)
        np.testing.assert_array_equal(found.data, STACK[0] if suffix == ".png" else STACK)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", [".mrc", ".npy", ".npz", ".png", ".tif", ".tiff", ".h5", ".emd", ".safetensors"])
@fuzz
@given(wounds=st.lists(damage, min_size=1, max_size=4))
def test_damaged_files_are_read_or_refused(
    suffix: str, wounds: list[tuple[str, float, int]], sound: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    assert faults(read(path, apply(sound[suffix], wounds)), path) == []


@pytest.mark.skipif(not NEEDLE.exists(), reason="the raw needle series is not here")
@pytest.mark.filterwarnings("ignore")
@settings(parent=fuzz, max_examples=max(1, EXAMPLES // 20))
@given(wounds=st.lists(damage, min_size=1, max_size=3))
def test_damaged_dm3_files_are_read_or_refused(wounds: list[tuple[str, float, int]], tmp_path: Path) -> None:
    path = tmp_path / "a.dm3"
    assert faults(read(path, apply(NEEDLE.read_bytes(), wounds)), path) == []


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", sorted(io.SUFFIXES - {".zarr"} | {".png"}))
@settings(parent=fuzz, max_examples=max(1, EXAMPLES // 6))
@given(content=st.binary(min_size=1, max_size=3000))
def test_any_bytes_are_refused_or_read(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    try:
        found = read(path, content)
    except ModuleNotFoundError as error:  # of an extra, which the message names
        assert "[camera-formats]" in str(error)  # noqa: PT017
        return
    assert faults(found, path) == []


@fuzz
@given(text=st.text(max_size=200))
def test_any_text_is_an_angle_file_or_refused(text: str, tmp_path: Path) -> None:
    for name, reader in (("a.tlt", io.read_tilts), ("a.mdoc", io.read_tilts), ("a.xf", io.read_transforms)):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8", errors="replace")
        refused = None
        try:
            found = reader(path)
        except ValueError as error:
            refused = str(error)
        if refused is None:
            assert np.isfinite(found).all()
            assert found.shape[1:] == ((2, 3) if name == "a.xf" else ())
            assert len(found) > 0
        else:
            assert name in refused


TABLES = {
    "a.aln": "# RawSize = 8 8 2\n# DarkFrame = 2 3 60\n1 85 1.0 0.5 -1 1 1 1 0 -3.0\n2 85 1.0 0 0 1 1 1 0 3.0\n",
    "a.star": "data_x\nloop_\n_rlnTomoYTilt #1\n_rlnMicrographName #2\n-3 1@a.mrc\n3 2@a.mrc\n",
    "a.tomostar": "data_\nloop_\n_wrpAngleTilt #1\n_wrpMovieName #2\n-3 a.tif\n3 'b c.tif'\n",
    "a.com": "$tilt\nTILTFILE a.txt\nOFFSET 1.5\nEXCLUDELIST 1-2\n",
    "a.mdoc": "PixelSpacing = 2\n[ZValue = 0]\nTiltAngle = -3\nPriorRecordDose = 1\n[FrameSet = 1]\nTiltAngle = 3\n",
    "a.txt": "tilt dose\n-3,5 1\n3,5 2 # last\n",
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", TABLES)
@fuzz
@given(place=st.integers(0, 200), length=st.integers(0, 8), text=st.text(max_size=8))
def test_damaged_tables_of_tilts_are_read_or_refused(
    name: str, place: int, length: int, text: str, tmp_path: Path
) -> None:
    (tmp_path / "a.txt").write_text(TABLES["a.txt"])
    sound = TABLES[name]
    (tmp_path / name).write_text(sound[:place] + text + sound[place + length :], encoding="utf-8", errors="replace")
    refused, table = "", None
    try:
        table = io.read_tilts(tmp_path / name)
    except FileNotFoundError:
        refused = "a.txt"  # damage to its name
    except ValueError as error:
        refused = str(error)
    if table is None:
        assert name in refused or "a.txt" in refused
        return
    assert np.isfinite(table.angles).all()
    for rows in (table.names, table.sections, table.transforms):
        assert rows is None or len(rows) in (0, len(table.angles))
