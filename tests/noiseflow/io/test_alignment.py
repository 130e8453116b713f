"""IMOD's alignments and angle files."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from noiseflow import io

RNG = np.random.default_rng(0)
IMAGES = RNG.random((3, 9, 9)).astype(np.float32)
IDENTITY = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_xf_files_are_read_and_wrong_ones_named(tmp_path: Path) -> None:
    path = tmp_path / "a.xf"
    path.write_text("   1.0 0.5   0.0 1.0   2.5  -3.5\n\n1 0 0 1 0 0\n")
    found = io.read_transforms(path)
    np.testing.assert_array_equal(found, [[[1, 0.5, 2.5], [0, 1, -3.5]], IDENTITY])
    for text, message in (
        ("1 0 0 1 0\n", "line 1: six numbers"),
        ("1 0 0 1 0 x\n", "line 1: six numbers"),
        ("1 1 1 1 0 0\n", "is not invertible"),
        ("nan 0 0 1 0 0\n", "is not invertible"),
        ("\n", "no transforms"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            io.read_transforms(path)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        io.read_transforms(tmp_path / "none.xf")


MDOC = """PixelSpacing = 2.1
[T = SerialEM: some title]
[ZValue = 1]
TiltAngle = -3.01
StagePosition = 1 2
[ZValue = 0]
TiltAngle = 0.02
[ZValue = 2]
TiltAngle = 3.0
"""


def test_mdoc_angles_come_in_the_order_of_the_stack(tmp_path: Path) -> None:
    path = tmp_path / "a.st.mdoc"
    path.write_text(MDOC)
    np.testing.assert_allclose(io.read_tilts(path).angles, [0.02, -3.01, 3.0])
    path.write_text("[ZValue = 0]\nTiltAngle = north\n")
    with pytest.raises(ValueError, match="not an angle"):
        io.read_tilts(path)


@pytest.mark.parametrize(
    ("stack", "beside", "expected"),
    [
        ("a.st", ["a.tlt", "a.rawtlt"], "a.rawtlt"),
        ("a.ali", ["a.tlt", "a.rawtlt"], "a.tlt"),
        ("a_ali.mrc", ["a.tlt", "a.rawtlt"], "a.tlt"),
        ("a.mrc", ["a.mrc.mdoc"], "a.mrc.mdoc"),
        ("a.st", ["a.mdoc"], "a.mdoc"),
        ("a.b.st", ["a.b.rawtlt", "a.rawtlt"], "a.b.rawtlt"),
    ],
)
def test_angles_beside_the_stack(tmp_path: Path, stack: str, beside: list[str], expected: str) -> None:
    for number, name in enumerate(beside, 1):
        text = f"[ZValue = 0]\nTiltAngle = {number}\n" if name.endswith("mdoc") else f"{number}\n"
        (tmp_path / name).write_text(text)
    found = io.tilts_of(tmp_path / stack, io.ImageFile(IMAGES[:1])).angles
    assert list(found) == [1 + beside.index(expected)]


def test_angles_inside_the_file_serve_where_none_lie_beside_it(tmp_path: Path) -> None:
    inside = np.array([-10.0, 0.0, 10.0])
    image = io.ImageFile(IMAGES, tilt_angles=inside)
    np.testing.assert_array_equal(io.tilts_of(tmp_path / "a.st", image).angles, inside)
    (tmp_path / "a.tlt").write_text("10\n0\n-10\n")
    with pytest.warns(UserWarning, match="10° for section 0"):
        np.testing.assert_array_equal(io.tilts_of(tmp_path / "a.st", image).angles, -inside)
    with pytest.raises(FileNotFoundError, match="--angles"):
        io.tilts_of(tmp_path / "b.st", io.ImageFile(IMAGES))


@pytest.mark.parametrize(("off", "warns"), [(1.9, False), (2.0, False), (-2.1, True)])
def test_angle_files_that_differ_by_more_than_two_degrees_are_pointed_out(
    tmp_path: Path, off: float, warns: bool
) -> None:
    inside = np.array([-10.0, 0.0, 10.0])
    (tmp_path / "a.tlt").write_text(f"-9.5\n{off}\n10.5\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = io.tilts_of(tmp_path / "a.st", io.ImageFile(IMAGES, tilt_angles=inside)).angles
    np.testing.assert_allclose(found, [-9.5, off, 10.5])
    assert [f"{off:g}° for section 1" in str(each.message) for each in caught] == [True] * warns
    with warnings.catch_warnings():  # another number of angles says nothing of the sections
        warnings.simplefilter("error")
        io.tilts_of(tmp_path / "a.st", io.ImageFile(IMAGES, tilt_angles=np.array([50.0, 0.0])))


@pytest.mark.parametrize("text", ["720\n", "-720\n", "0\n"])
def test_angles_of_two_full_turns_are_the_largest(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.tlt").write_text(text)
    assert io.read_tilts(tmp_path / "a.tlt").angles.tolist() == [float(text)]
    for beyond in ("721", "-720.5", "1e30"):
        (tmp_path / "a.tlt").write_text(f"\n0\n{beyond}\n")
        with pytest.raises(ValueError, match=f"line 3: {beyond} is not a tilt angle"):
            io.read_tilts(tmp_path / "a.tlt")


def test_words_are_a_title_only_above_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.tlt").write_text("\nhello\nthere\nworld\n")
    with pytest.raises(ValueError, match="line 2: 'hello' is not an angle"):
        io.read_tilts(tmp_path / "a.tlt")
    (tmp_path / "a.tlt").write_text("of a microscope\nangles\n-3\n3\n")
    assert io.read_tilts(tmp_path / "a.tlt").angles.tolist() == [-3, 3]


def test_a_folder_has_its_angles_inside_or_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "tilts"
    folder.mkdir()
    image = io.ImageFile(IMAGES[:1])
    (folder / "any.rawtlt").write_text("1\n")
    assert io.tilts_of(folder, image).angles.tolist() == [1.0]
    (folder / "other.mdoc").write_text("[ZValue = 0]\nTiltAngle = 2\n")
    with pytest.raises(FileNotFoundError, match=r"no tilts\.rawtlt, tilts\.tlt or \.mdoc"):  # which of the two?
        io.tilts_of(folder, image)
    (tmp_path / "tilts.tlt").write_text("3\n")
    assert io.tilts_of(folder, image).angles.tolist() == [3.0]
    (tmp_path / "a.rawtlt").write_text("4\n")
    assert io.tilts_of(f"{tmp_path / 'a.h5'}::group/data", image).angles.tolist() == [4.0]


def test_an_mdoc_tells_nothing_before_its_first_section(tmp_path: Path) -> None:
    (tmp_path / "a.mdoc").write_text(
        "TiltAngle = 70\n[ ZValue = 3 ]\n  TiltAngle = 1.5 \n[ZValue = 12]\nTiltAngle=-2\n"
    )
    assert io.read_tilts(tmp_path / "a.mdoc").angles.tolist() == [1.5, -2.0]


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        (["DateTime = 12-May-20 14:00:05", "DateTime = 12-May-20  14:00:45"], [0, 40]),
        (["DateTime = 2020-05-12 14:00:05", "DateTime = 2020-05-12 13:59:55"], [10, 0]),
        (["PriorRecordDose = 3.5", "PriorRecordDose = 0"], [3.5, 0]),
        (["DateTime = yesterday", "DateTime = today"], None),
        (["ExposureTime = 1", "ExposureTime = 1"], None),
    ],
)
def test_an_mdoc_tells_when_images_were_taken(tmp_path: Path, entries: list[str], expected: list[float] | None) -> None:
    sections = (f"[ZValue = {n}]\nTiltAngle = {n}\n{entry}\n" for n, entry in enumerate(entries))
    (tmp_path / "a.mdoc").write_text("".join(sections))
    found = io.read_tilts(tmp_path / "a.mdoc").acquired
    assert (None if found is None else list(found - found.min())) == expected
