"""The direction of the tilt axis is read wherever microscopes state it."""

import struct
from pathlib import Path

import numpy as np
import pytest

from noiseflow import io

IMAGES = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)


def axis_of(path: Path) -> float | None:
    return io.tilt_axis_of(path, io.read(path))


def stack(tmp_path: Path) -> Path:
    path = tmp_path / "tilts.mrc"
    io.write(path, IMAGES)
    return path


def with_header(path: Path, offset: int, content: bytes) -> None:
    raw = bytearray(path.read_bytes())
    raw[offset : offset + len(content)] = content
    path.write_bytes(raw)


def test_nothing_stated_is_none(tmp_path: Path) -> None:
    assert axis_of(stack(tmp_path)) is None


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        (
            "[T =     Tilt axis angle = -86.7, binning = 1 spot = 7 camera = 1]\n[ZValue = 0]\nRotationAngle = 3.3\n",
            -86.7,
        ),
        ("[ZValue = 0]\nTiltAngle = 1\nRotationAngle = 174.5\n[ZValue = 1]\nRotationAngle = 174.6\n", 84.5),
        ("[ZValue = 0]\nTiltAngle = 1\n", None),
    ],
)
@pytest.mark.parametrize("name", ["tilts.mrc.mdoc", "tilts.mdoc"])
def test_mdoc_titles_count_before_its_sections(tmp_path: Path, text: str, axis: float | None, name: str) -> None:
    (tmp_path / name).write_text(text)
    assert axis_of(stack(tmp_path)) == (None if axis is None else pytest.approx(axis))


def test_title_of_the_stack_and_log_of_the_microscope(tmp_path: Path) -> None:
    path = stack(tmp_path)
    (tmp_path / "tilts.txt").write_text("11/18/11 10:36:43\tTilt Axis Angle [°]:90.00\n", encoding="latin-1")
    assert axis_of(path) == 90.0
    with_header(path, 224, b"    Tilt axis angle = 12.5, binning = 1  spot = 3  camera = 0".ljust(80))
    assert axis_of(path) == 12.5


@pytest.mark.parametrize(("value", "axis"), [(85.0, 85.0), (0.0, None)])
def test_old_extended_headers_state_it_unless_it_is_zero(tmp_path: Path, value: float, axis: float | None) -> None:
    path = stack(tmp_path)
    raw = path.read_bytes()
    records = np.zeros((3, 32), "<f4")
    records[:, 0], records[:, 10] = (-10, 0, 10), value
    header = bytearray(raw[:1024])
    header[92:96] = struct.pack("<i", records.nbytes)
    header[104:108] = bytes(4)
    header[128:132] = struct.pack("<hh", 0, 32)
    path.write_bytes(bytes(header) + records.tobytes() + raw[1024:])
    assert axis_of(path) == axis
    assert io.read(path).tilt_angles.tolist() == [-10, 0, 10]


def test_real_log_beside_a_real_stack() -> None:
    needle = Path(__file__).parents[4] / "shared" / "data" / "tilt_needle_256" / "needle_256_raw.mrc"
    if not needle.exists():
        pytest.skip("the raw needle series is not here")
    assert axis_of(needle) == 90.0
