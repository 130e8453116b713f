"""Tilt series as microscopes and other programs leave them, each with its right answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import recon
from noiseflow import io
from recon.series.tilt_series import as_if_in_radians

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # files that lead to warnings open all the same

CASES = Path(__file__).parents[2] / "shared" / "data" / "cases_series"
DATA = Path(__file__).parents[2] / "shared" / "data"
with_cases = pytest.mark.skipif(not CASES.is_dir(), reason="the small series are not here")


@with_cases
@pytest.mark.parametrize("name", ["hyper.tif", "c2.ome.tif"])
def test_one_of_several_channels_is_chosen_and_never_guessed(name: str, refused, tmp_path: Path) -> None:
    with pytest.raises(io.SeveralImages) as caught:
        recon.read_tilt_series(CASES / name)
    assert caught.value.names == ("0", "1")
    first, second = (recon.read_tilt_series(CASES / name, channel=channel) for channel in (0, "1"))
    assert first.images.shape == second.images.shape == (31, 32, 32)
    assert first.images.std() == pytest.approx(2 * second.images.std(), rel=1e-3)
    mapped = io.read(f"{CASES / name}::1", mapped=True)
    np.testing.assert_array_equal(mapped.data, second.images)
    assert "--channel" in refused("reconstruct", CASES / name, "-o", tmp_path / "v.mrc")
    with pytest.raises(ValueError, match="holds no '2'"):
        io.read(CASES / name, channel=2)


def test_channels_have_the_names_that_ome_gives_them(tmp_path: Path) -> None:
    data = np.random.default_rng(0).integers(0, 99, (2, 5, 6, 7)).astype(np.uint16)
    metadata = {"axes": "CZYX", "Channel": {"Name": ["HAADF", "Fe"]}}
    tifffile.imwrite(tmp_path / "maps.ome.tif", data, metadata=metadata)
    with pytest.raises(io.SeveralImages) as caught:
        io.read(tmp_path / "maps.ome.tif")
    assert caught.value.names == ("HAADF", "Fe")
    np.testing.assert_array_equal(io.read(tmp_path / "maps.ome.tif", channel="Fe").data, data[1])
    tifffile.imwrite(tmp_path / "one.tif", data[0])
    with pytest.raises(ValueError, match="holds one image"):
        io.read(tmp_path / "one.tif", channel="Fe")


def projections(name: str, angles: np.ndarray) -> np.ndarray:
    """Noise-free images of a known volume."""
    from recon.metrics.comparison import project

    return project(io.read(CASES / name).data, angles)


def likeness(images: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Correlation of each image with its counterpart."""
    return np.array([np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(images, others, strict=True)])


@with_cases
@pytest.mark.parametrize(
    ("name", "pixel_size"), [("frames_subframepath", 5.4), ("one_mrc_one_mdoc_per_tilt", 7.88), ("nxtomo.nxs", 15.0)]
)
def test_every_image_has_its_own_angle_and_the_pixel_size_of_the_metadata(name: str, pixel_size: float) -> None:
    series = recon.read_tilt_series(CASES / name, mode="linear")
    assert sorted(series.tilt_angles) == list(range(-60, 61, 4))
    assert series.pixel_size == pytest.approx(pixel_size, rel=1e-3)
    alike = likeness(series.images, projections("truth.mrc", series.tilt_angles))
    assert alike.min() > 0.9


@with_cases
@pytest.mark.parametrize(("name", "count"), [("nxtomo.nxs", 31), ("de360.h5", 31)])
def test_flat_and_dark_frames_are_applied_and_are_no_tilts(name: str, count: int) -> None:
    with pytest.warns(UserWarning, match="flat and dark fields"):
        series = recon.read_tilt_series(CASES / name)
    assert series.num_tilts == count
    assert np.isfinite(series.images).all()
    assert -0.1 < series.images.min() < series.images.max() < 2


@with_cases
def test_angles_of_a_full_turn_are_read(tmp_path: Path) -> None:
    assert recon.read_tilt_series(CASES / "de360.h5").tilt_angles[[0, -1]].tolist() == [0, 350]


@pytest.mark.parametrize(
    ("edges", "shape"), [((10, 20), (4, 12, 8)), ((20, 10), (4, 6, 16)), ((10, 12.5), (4, 12, 12))]
)
def test_pixels_become_square_and_counts_stay_counts(
    edges: tuple[float, float], shape: tuple[int, int, int], tmp_path: Path
) -> None:
    counts = np.random.default_rng(0).poisson(3.0, (4, 12, 16)).astype(np.int16)
    mask, (x, y) = np.ones(counts.shape, np.bool_), edges
    mask[1, 4, 5] = False
    io.write(tmp_path / "a.mrc", counts, voxel_size=(1, y, x), stack=True)
    (tmp_path / "a.rawtlt").write_text("-20\n-10\n10\n20\n")
    with pytest.warns(UserWarning, match=f"{x:g} x {y:g}"):
        series = recon.read_tilt_series(tmp_path / "a.mrc", mask=mask)
    assert series.images.shape == shape
    assert series.pixel_size == max(edges)
    if max(edges) / min(edges) == 2:
        summed = counts.reshape(4, shape[1], 12 // shape[1], shape[2], 16 // shape[2]).sum((2, 4))
        assert series.images.dtype.kind == "i"
        np.testing.assert_array_equal(series.images[series.used], summed[series.used])
        assert (~series.used).sum() == 1
    else:  # 12 pixels of 12.5 Å show 15 of the 16 pixels of 10 Å
        shares = np.r_[0.5, np.ones(14), 0.5] / 15
        np.testing.assert_allclose(series.images[0].mean(1), counts[0] @ shares, rtol=1e-5)
    assert recon.read_tilt_series(tmp_path / "a.mrc", pixel_size=12).images.shape == counts.shape


TEXTS = {
    "a second column": ("-60 1\n-58 2\n-56 4\n", [-60, -58, -56]),
    "numbered rows": ("1 -60\n2 -58\n3 -56\n", [-60, -58, -56]),
    "a title": ("dose,tilt\n0,-60\n2.5,-58\n5.5,-56\n", [-60, -58, -56]),
    "decimal commas": ("-60,5\n-58,25\n-56\n", [-60.5, -58.25, -56]),
    "comments": ("# tilts\n-60 ! first\n\n-58 // second\n-56\n", [-60, -58, -56]),
    "one line": ("-60 -58 -56\n", [-60, -58, -56]),
    "one line, commas": ("-60, -58,-56\n", [-60, -58, -56]),
    "one line, semicolons": ("-60,5;-58,5;-56,5", [-60.5, -58.5, -56.5]),
    "units": ("tilt (degrees)\n-60 deg\n-58 deg\n-56 deg\n", [-60, -58, -56]),
    "title in another language": ("Serie\nWinkel\n-60\n-58\n-56\n", [-60, -58, -56]),
    "quoted": ('"angle","dose"\n"-60","0"\n"-58","3"\n"-56","6"\n', [-60, -58, -56]),
    "json": ("[-60.0, -58.0, -56.0]\n", [-60, -58, -56]),
    "titles of other angles": ("file,defocusAngle,stage\na,30,-60\nb,31,-58\nc,33,-56\n", [-60, -58, -56]),
    "title of the axis": ("tilt_axis;tilt\n-85;-60\n-85;-58\n-85;-56\n", [-60, -58, -56]),
    "end mark of old files": ("-60\r\n-58\r\n-56\r\n\x1a", [-60, -58, -56]),
    "names of images": ("b_001.tif -60\nb_002.tif -58\nb_003.tif -56\n", [-60, -58, -56]),
    "typographic minus": ("−60\n−58\n−56°\n", [-60, -58, -56]),
}


@pytest.mark.filterwarnings("ignore:.*columns")
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("name", TEXTS)
def test_lists_of_angles_as_people_write_them(name: str, encoding: str, tmp_path: Path) -> None:
    text, expected = TEXTS[name]
    if encoding in ("utf-16-le", "utf-16-be") and not text.isascii():
        pytest.skip("without a mark, this encoding is found for plain text only")
    (tmp_path / "a.tlt").write_text(text, encoding=encoding)
    assert io.read_tilts(tmp_path / "a.tlt").angles.tolist() == expected


@pytest.mark.parametrize("text", ["1,0\n2,0\n3,0\n", "0 0\n1 2.5\n2 5\n", "1 2\n3\n", "1 2\n3 x\n"])
def test_lists_that_may_be_read_in_two_ways_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.tlt").write_text(text)
    with pytest.raises(ValueError, match=r"a\.tlt"):
        io.read_tilts(tmp_path / "a.tlt")


MDOCS = {
    "sections": "[ZValue = 1]\nTiltAngle = 3\n[ZValue = 0]\nTiltAngle = -3\n[ZValue = 2]\nTiltAngle = 9\n",
    "frame sets": "".join(f"[FrameSet = 0]\nTiltAngle = {a}\nSubFramePath = D:\\x\\f{a}.tif\n" for a in (-3, 3, 9)),
    "images": "".join(f"[Image = f{a}.tif]\nTiltAngle = {a}\n" for a in (-3, 3, 9)),
    "montages": "".join(
        f"[ZValue = {a + 3}]\nTiltAngle = {a}\n[MontSection = 0]\nTiltAngle = 77\n" for a in (-3, 3, 9)
    ),
    "lower case": "".join(f"[zvalue={n}]\ntiltangle={a}\n" for n, a in enumerate((-3, 3, 9))),
}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("name", MDOCS)
def test_mdoc_files_of_every_kind(name: str, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.mdoc").write_text(f"PixelSpacing = 2.5\n{MDOCS[name]}", encoding=encoding)
    table = io.read_tilts(tmp_path / "a.mdoc")
    assert table.angles.tolist() == [-3, 3, 9]
    assert table.pixel_size == 2.5
    assert table.names in ((), ("D:\\x\\f-3.tif", "D:\\x\\f3.tif", "D:\\x\\f9.tif"), ("f-3.tif", "f3.tif", "f9.tif"))


def folder_of(folder: Path, names: list[str], stack: np.ndarray) -> Path:
    folder.mkdir()
    for name, image in zip(names, stack, strict=True):
        tifffile.imwrite(folder / name, image, photometric="minisblack")
    return folder


STACK = np.random.default_rng(1).integers(0, 999, (3, 8, 9)).astype(np.uint16)


@pytest.mark.parametrize(
    ("images", "rows"),
    [
        (["b.tif", "a.tif", "c.tif"], ["a.eer", "b.eer", "c.eer"]),
        (["b_DW.tif", "a_DW.tif", "c_DW.tif"], ["X:\\m\\a.tif", "X:\\m\\b.tif", "X:\\m\\c.tif"]),
        (["t_3.0.tif", "t_-3.0.tif", "t_9.0.tif"], ["p", "q", "r"]),  # no name is the same, but the angles are
    ],
)
def test_images_and_angles_are_joined_by_name(images: list[str], rows: list[str], tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "tilts", images, STACK)
    text = "".join(f"[Image = {row}]\nTiltAngle = {a}\n" for row, a in zip(rows, (-3.1, 3.1, 9.1), strict=True))
    (folder / "all.mdoc").write_text(text)
    series = recon.read_tilt_series(folder)
    for angle, image in zip(series.tilt_angles, series.images, strict=True):
        np.testing.assert_array_equal(image, STACK[{3.1: 0, -3.1: 1, 9.1: 2}[angle]])


def test_a_plain_list_in_another_order_is_joined_by_the_angles_in_names(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "tilts", ["t_3.0.tif", "t_-3.0.tif", "t_9.0.tif"], STACK)
    (folder / "a.tlt").write_text("-3.1\n3.1\n9.1\n")
    image = io.read(folder)
    with pytest.warns(UserWarning, match="by the angles in the names"):
        table = io.tilts_of(folder, image)
    found = dict(zip(image.names, table.angles, strict=True))
    assert found == {"t_3.0.tif": 3.1, "t_-3.0.tif": -3.1, "t_9.0.tif": 9.1}
    (folder / "a.tlt").write_text("-30\n0\n30\n")  # other angles: by order, with a warning
    with pytest.warns(UserWarning, match="angle file is used"):
        assert io.tilts_of(folder, image).angles.tolist() == [-30, 0, 30]


def test_images_that_the_file_does_not_name_are_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "tilts", ["a.tif", "b.tif", "x.tif"], STACK)
    (folder / "all.mdoc").write_text("".join(f"[Image = {n}.tif]\nTiltAngle = {k}\n" for k, n in enumerate("abc")))
    with pytest.raises(ValueError, match=r"all\.mdoc.*x\.tif"):
        recon.read_tilt_series(folder)


def test_lists_of_another_length_are_refused_with_both_files_and_counts(tmp_path: Path) -> None:
    io.write(tmp_path / "a.mrc", STACK)
    (tmp_path / "a.rawtlt").write_text("1\n2\n")
    with pytest.raises(ValueError, match=r"a\.mrc has 3 images.*2 tilt angles.*a\.rawtlt"):
        recon.read_tilt_series(tmp_path / "a.mrc")


@pytest.mark.filterwarnings("ignore:.*more than once")
@pytest.mark.parametrize("join", ["mdoc for each movie", "one mdoc", "names"])
def test_movies_of_one_tilt_each_are_summed(join: str, tmp_path: Path) -> None:
    movies = np.random.default_rng(0).integers(0, 60_000, (3, 4, 8, 9)).astype(np.uint16)
    named = [f"m_{a:.1f}.tif" if join == "names" else f"m{k}.tif" for k, a in enumerate((6, -6, 0))]
    folder = folder_of(tmp_path / "movies", named, movies)
    sections = [
        f"[FrameSet = 0]\nTiltAngle = {a}\nSubFramePath = c:\\{n}\n" for n, a in zip(named, (6, -6, 0), strict=True)
    ]
    if join == "one mdoc":
        (folder / "series.mdoc").write_text("".join(sections))
    elif join != "names":
        for name, section in zip(named, sections, strict=True):
            (folder / f"{name}.mdoc").write_text(section)
    with pytest.warns(UserWarning, match="4 frames"):
        series = recon.read_tilt_series(folder)
    for angle, image in zip(series.tilt_angles, series.images, strict=True):
        np.testing.assert_array_equal(image, movies[[6, -6, 0].index(angle)].sum(0))


def test_stacks_that_may_be_tilt_series_are_not_summed(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "series", ["a.tif", "b.tif"], STACK[None].repeat(2, 0))
    with pytest.raises(ValueError, match="single images"):
        recon.read_tilt_series(folder)


def test_views_are_excluded_as_imod_counts_them(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((6, 8, 9)).astype(np.float32)
    io.write(tmp_path / "a.st", stack)
    (tmp_path / "a.rawtlt").write_text("".join(f"{angle}\n" for angle in range(-30, 30, 10)))
    series = recon.read_tilt_series(tmp_path / "a.st", exclude_views="1,3-4")
    assert series.tilt_angles.tolist() == [-20, 10, 20]
    np.testing.assert_array_equal(series.images, stack[[1, 4, 5]])
    (tmp_path / "a.xf").write_text("".join(f"1 0 0 1 {k} 0\n" for k in range(6)))
    shifts = recon.read_alignment(tmp_path / "a.xf", series).shifts
    assert shifts[:, 1].tolist() == [-1, -4, -5]
    for wrong in ("7", "0", "3-2", "x", "1-6"):
        with pytest.raises(ValueError, match="view"):
            recon.read_tilt_series(tmp_path / "a.st", exclude_views=wrong)


def test_tilt_com_adds_its_offset_and_excludes_its_views(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 8, 9)).astype(np.float32)
    io.write(tmp_path / "a_ali.mrc", stack)
    (tmp_path / "a.tlt").write_text("-20\n-10\n10\n20\n")
    command = (
        "$tilt -StandardInput\nInputProjections a_ali.mrc\nTILTFILE a.tlt\nOFFSET 1.5\nEXCLUDELIST 2\nXAXISTILT 3.0\n"
    )
    (tmp_path / "tilt.com").write_text(command)
    with pytest.warns(UserWarning, match=r"1\.5.*views 2"), pytest.warns(UserWarning, match="about x"):
        series = recon.read_tilt_series(tmp_path / "a_ali.mrc")
    assert series.x_tilt == 3
    assert series.tilt_angles.tolist() == [-18.5, 11.5, 21.5]
    np.testing.assert_array_equal(series.images, stack[[0, 2, 3]])
    with pytest.warns(UserWarning, match="about x"):
        given = recon.read_tilt_series(tmp_path / "a_ali.mrc", angles=tmp_path / "tilt.com")
    assert given.tilt_angles.tolist() == series.tilt_angles.tolist()
    (tmp_path / "a.xf").write_text("1 0 0 1 0 0\n" * 4)
    io.write(tmp_path / "a.mrc", stack)
    (tmp_path / "a.rawtlt").write_text("-19\n-9\n11\n21\n")
    raw = recon.read_tilt_series(tmp_path / "a.mrc")
    assert raw.tilt_angles.tolist() == [-17.5, 12.5, 22.5]
    refined = recon.read_alignment(tmp_path / "a.xf", raw).joined(raw).apply(raw)
    assert refined.tilt_angles.tolist() == series.tilt_angles.tolist()
    io.write(tmp_path / "b.mrc", stack)
    (tmp_path / "b.tlt").write_text("-20\n-10\n10\n20\n")
    assert recon.read_tilt_series(tmp_path / "b.mrc").num_tilts == 4  # the command file of another stack


# the columns of a tilt series of RELION 5 after its alignment; the pixel size is in the list of all series
RELION = """
# version 50001

data_TS_01

loop_
_rlnMicrographMovieName #1
_rlnTomoTiltMovieFrameCount #2
_rlnTomoNominalStageTiltAngle #3
_rlnTomoNominalTiltAxisAngle #4
_rlnMicrographPreExposure #5
_rlnTomoNominalDefocus #6
_rlnMicrographName #7
_rlnTomoXTilt #8
_rlnTomoYTilt #9
_rlnTomoZRot #10
_rlnTomoXShiftAngst #11
_rlnTomoYShiftAngst #12
frames/c.tif\t8\t 30.0\t85.0\t6.0\t-4.0\tMotionCorr/job002/c.mrc  0.000000  30.500000  90.000000  5.000000 -2.500000
frames/a.tif\t8\t-30.0\t85.0\t3.0\t-4.0\tMotionCorr/job002/a.mrc  0.000000 -29.500000  90.000000 10.000000  0.000000
frames/b.tif\t8\t  0.0\t85.0\t0.0\t-4.0\tMotionCorr/job002/b.mrc  0.000000   0.500000  90.000000  0.000000  0.000000
"""
# as WarpTools' ts_import writes it
WARP = """
data_

loop_
_wrpMovieName #1
_wrpAngleTilt #2
_wrpAxisAngle #3
_wrpDose #4
_wrpAverageIntensity #5
_wrpMaskedFraction #6
  ../warp_frameseries/c.tif   30.5   85.000   105.600006   3.854   0.000
  ../warp_frameseries/a.tif  -29.5   85.000       102.96   3.950   0.000
  ../warp_frameseries/b.tif    0.5   85.000            0   3.953   0.000
"""


@pytest.mark.parametrize(("suffix", "text"), [(".star", RELION), (".tomostar", WARP)])
def test_tables_of_relion_and_warp_join_movies_by_name(suffix: str, text: str, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "movies", ["a.tif", "b.tif", "c.tif"], STACK)
    (folder / f"series{suffix}").write_text(text)
    series = recon.read_tilt_series(folder)
    assert series.tilt_angles.tolist() == [-29.5, 0.5, 30.5]
    assert series.tilt_axis == 85
    assert series.dose is not None
    assert series.dose.argsort().tolist() == [1, 0, 2]


ARETOMO = """# AreTomo Alignment / Priims bprmMn
# RawSize = 40 30 4
# NumPatches = 1
# DarkFrame =     3    4    61.00
# AlphaOffset =     1.00
# BetaOffset =     4.00
# Thickness = 20
# SEC     ROT         GMAG       TX          TY      SMEAN     SFIT    SCALE     BASE     TILT
    1   -80.0000    1.00000      3.000     -2.000     1.00     1.00     1.00     0.00    -29.00
    2   -80.0000    1.00000     -1.500      0.500     1.00     1.00     1.00     0.00      1.00
    3   -80.0000    1.00000      0.000      4.000     1.00     1.00     1.00     0.00     31.00
# Local Alignment
   0   0    -8.00      6.00     -0.10      0.20   1.0
   1   0    -8.00      6.00     -0.10      0.20   1.0
   2   0    -8.00      6.00     -0.10      0.20   1.0
"""


@pytest.mark.parametrize("program", ["AreTomo", "RELION"])
def test_alignments_of_other_programs_lead_from_aligned_to_raw_images(program: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).random((4, 30, 40)).astype(np.float32)
    angles, views = np.array([-30.0, 0.0, 30.0, 60.0]), "4"
    path = tmp_path / ("a.aln" if program == "AreTomo" else "a.star")
    path.write_text(ARETOMO if program == "AreTomo" else RELION)
    io.write(tmp_path / "a.mrc", noise, voxel_size=(2.5,) * 3)
    np.savetxt(tmp_path / "a.rawtlt", angles)
    if program == "RELION":
        io.write(tmp_path / "a.mrc", noise[:3], voxel_size=(2.5,) * 3)
        np.savetxt(tmp_path / "a.rawtlt", [30, -30, 0])
        views = ""
    series = recon.read_tilt_series(tmp_path / "a.mrc", exclude_views=views)
    alignment = recon.read_alignment(path, series)
    assert alignment.x_tilt == (4 if program == "AreTomo" else 0)
    assert alignment.apply(series).x_tilt == alignment.x_tilt
    assert alignment.tilt_axis == pytest.approx(-80 if program == "AreTomo" else 90)
    expected = [[-2, 3], [0.5, -1.5], [4, 0]] if program == "AreTomo" else [[-1, 2], [0, 4], [0, 0]]
    np.testing.assert_allclose(alignment.shifts, expected, atol=1e-9)
    np.testing.assert_allclose(alignment.joined(series).refined_angles, [-29, 1, 31] if views else [30.5, -29.5, 0.5])
    binned = recon.read_tilt_series(tmp_path / "a.mrc", exclude_views=views, pixel_size=5.0)
    if program == "RELION":
        np.testing.assert_allclose(alignment.joined(binned).shifts, np.array(expected) / 2, atol=1e-9)
        with pytest.raises(ValueError, match="--pixel-size"):
            recon.read_alignment(path, replace(series, pixel_size=None))
    else:
        half = recon.TiltSeries(binned.images[:, :15, :20], binned.tilt_angles, 5.0)
        np.testing.assert_allclose(alignment.joined(half).shifts, np.array(expected) / 2, atol=1e-9)
    with (
        pytest.raises(ValueError, match=r"has no tilt at 60|transforms")
        if views
        else pytest.raises(ValueError, match="binning")
    ):
        recon.read_alignment(path, series, binning=0 if not views else None).joined(
            recon.read_tilt_series(tmp_path / "a.mrc")
        )


@with_cases
def test_transforms_of_imod_turn_the_frame_and_mask_what_lies_outside() -> None:
    series = recon.read_tilt_series(CASES / "wide.mrc")
    aligned = recon.read_alignment(CASES / "wide.xf", series).joined(series).apply(series)
    assert aligned.images.shape == (31, 48, 32)
    assert aligned.mask is None  # a quarter turn shows the whole frame
    alike = likeness(aligned.images, projections("truth48.mrc", aligned.tilt_angles))
    assert alike.min() > 0.9


def test_transforms_made_on_unbinned_images_are_scaled(tmp_path: Path) -> None:
    raw = np.random.default_rng(0).random((3, 32, 48)).astype(np.float32)
    (tmp_path / "a.xf").write_text("1 0 0 1 8 -4\n" * 3)
    io.write(tmp_path / "a_bin4.mrc", raw.reshape(3, 8, 4, 12, 4).mean((2, 4)))
    np.savetxt(tmp_path / "a_bin4.rawtlt", [-30, 0, 30])
    series = recon.read_tilt_series(tmp_path / "a_bin4.mrc")
    with pytest.warns(UserWarning, match="--alignment-binning"):
        recon.read_alignment(tmp_path / "a.xf", series)
    given = recon.read_alignment(tmp_path / "a.xf", series, binning=4).joined(series)
    assert given.shifts[0].tolist() == [1, -2]
    io.write(tmp_path / "a.st", raw)  # the stack that was aligned
    assert recon.read_alignment(tmp_path / "a.xf", series).joined(series).shifts[0].tolist() == [1, -2]


@with_cases
def test_pixels_are_in_the_sense_that_their_writer_meant() -> None:
    plain = io.read(CASES / "bf_u8.tif").data
    np.testing.assert_array_equal(io.read(CASES / "bf_imodsigned.mrc").data, plain)
    masks = [io.read(CASES / name).data != 0 for name in ("mask_imod.mrc", "mask_ok.tif")]
    np.testing.assert_array_equal(*masks)
    assert io.read(CASES / "u8_nostat.mrc").data.max() == 250
    with pytest.warns(UserWarning, match="MINISWHITE"):
        white = recon.read_tilt_series(CASES / "msw.tif")
    assert likeness(white.images, projections("truth.mrc", white.tilt_angles)).min() > 0.9


@pytest.mark.parametrize("mapped", [False, True])
def test_miniswhite_is_inverted_for_every_depth(tmp_path: Path, mapped: bool) -> None:
    for kind in (np.uint8, np.uint16):
        data = np.arange(120).reshape(4, 5, 6).astype(kind)
        tifffile.imwrite(tmp_path / "a.tif", np.iinfo(kind).max - data, photometric="miniswhite")
        with pytest.warns(UserWarning, match="MINISWHITE"):
            np.testing.assert_array_equal(io.read(tmp_path / "a.tif", mapped=mapped).data, data)
    tifffile.imwrite(tmp_path / "a.tif", data.astype(np.float32), photometric="miniswhite")
    with pytest.raises(ValueError, match="MINISWHITE"):
        io.read(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("unit", "rate", "angstrom"),
    [
        *(("CENTIMETER", 1e7, 10), ("MILLIMETER", 1e6, 10), ("MICROMETER", 1e3, 10), ("INCH", 2.54e7, 10)),
        *(("INCH", 300, None), ("INCH", 1200, None), ("NONE", 5, None)),
    ],
)
def test_resolutions_for_printers_are_sizes_if_they_are_fine_enough(
    tmp_path: Path, unit: str, rate: float, angstrom
) -> None:
    tifffile.imwrite(tmp_path / "a.tif", STACK, resolution=(rate, rate), resolutionunit=unit, photometric="minisblack")
    found = io.read(tmp_path / "a.tif").voxel_size
    assert found == (None if angstrom is None else pytest.approx((angstrom,) * 3, rel=1e-6))


@pytest.mark.parametrize("suffix", [".mrc.gz", ".st.bz2", ".preali", ".hdf"])
def test_packed_stacks_and_further_suffixes(suffix: str, tmp_path: Path) -> None:
    import bz2
    import gzip

    import h5py

    path = tmp_path / f"series{suffix}"
    io.write(tmp_path / "plain.mrc", STACK, voxel_size=(3.0,) * 3)
    plain = (tmp_path / "plain.mrc").read_bytes()
    if suffix == ".hdf":
        with h5py.File(path, "w") as file:
            file["images"] = STACK
    else:
        path.write_bytes({".mrc.gz": gzip.compress, ".st.bz2": bz2.compress}.get(suffix, bytes)(plain))
    (tmp_path / "series.rawtlt").write_text("-9\n0\n9\n")
    series = recon.read_tilt_series(path)
    np.testing.assert_array_equal(series.images, STACK)
    assert series.tilt_angles.tolist() == [-9, 0, 9]
    if suffix != ".hdf":
        path.write_bytes(path.read_bytes()[:-60])
        with pytest.raises(ValueError, match="cannot be read"):
            recon.read_tilt_series(path)


def test_an_emi_file_needs_the_ser_file_of_its_pixels(tmp_path: Path) -> None:
    (tmp_path / "a.emi").write_bytes(bytes(100))
    with pytest.raises(ValueError, match=r"a_1\.ser"):
        io.read(tmp_path / "a.emi")


def test_an_emi_file_opens_with_the_ser_file_of_its_pixels(tmp_path: Path) -> None:
    from tests.noiseflow.io.test_microscope import write_ser

    times, tags = "<DwellTimePath>1e-6</DwellTimePath>", "<ExperimentalDescription><Root/></ExperimentalDescription>"
    info = f"<ObjectInfo><AcquireInfo>{times}</AcquireInfo>{tags}</ObjectInfo>"
    (tmp_path / "a.emi").write_bytes(b"\0\0" + info.encode() + b"\0")
    write_ser(tmp_path / "a_1.ser", STACK[0], 2e-10)
    np.testing.assert_array_equal(io.read(tmp_path / "a.emi").data, STACK[0][::-1])


def test_written_files_are_valid_and_say_whether_they_are_stacks_or_volumes(tmp_path: Path, run) -> None:
    import mrcfile

    from noiseflow.io.mapped import create_volume, finish_volume

    run("simulate", tmp_path / "new", "--size", "16", "--tilts", "-60:60:20", "--noise", "none")
    series = recon.read_tilt_series(tmp_path / "new" / "tilts.mrc", pixel_size=5.0)
    recon.write_tilt_series(tmp_path / "stack.mrc", series)
    recon.Volume(np.random.default_rng(0).random((4, 5, 6)), 5.0).write(tmp_path / "volume.mrc")
    blocks = create_volume(tmp_path / "blocks.mrc", (4, 5, 6), (5.0, 5.0, 5.0))
    blocks[:] = np.random.default_rng(0).random((4, 5, 6))
    finish_volume(tmp_path / "blocks.mrc", blocks)
    stacks = ["stack.mrc", *(f"new/{name}.mrc" for name in ("tilts", "clean", "validation", "test"))]
    for name in [*stacks, "new/truth.mrc", "volume.mrc", "blocks.mrc"]:
        assert mrcfile.validate(tmp_path / name), name
        with mrcfile.open(tmp_path / name) as file:
            assert file.is_image_stack() == (name in stacks)
            found = [float(file.header[key]) for key in ("dmin", "dmax", "dmean", "rms")]
            data = file.data.astype(np.float64)
            np.testing.assert_allclose(found, [data.min(), data.max(), data.mean(), data.std()], rtol=1e-4, atol=1e-6)
            if "new" not in name:
                assert float(file.voxel_size.x) == float(file.voxel_size.z) == 5.0


def test_dark_frames_of_aretomo_are_excluded_and_sections_put_in_order(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 30, 40)).astype(np.float32)
    io.write(tmp_path / "a.mrc", stack)
    (tmp_path / "a.aln").write_text(ARETOMO)
    series = recon.read_tilt_series(tmp_path / "a.mrc")
    assert series.tilt_angles.tolist() == [-29, 1, 31]
    np.testing.assert_array_equal(series.images, stack[:3])
    star = (
        "data_\nloop_\n_rlnMicrographName #1\n_rlnTomoYTilt #2\n000003@a.mrc 30\n1@a.mrc -30\n2@a.mrc 0\n4@a.mrc 60\n"
    )
    (tmp_path / "a.star").write_text(star)
    assert recon.read_tilt_series(tmp_path / "a.mrc").tilt_angles.tolist() == [-30, 0, 30, 60]


def test_sections_of_aretomo_count_from_one_or_from_zero(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 30, 40)).astype(np.float32)
    io.write(tmp_path / "a.mrc", stack)
    rows = ARETOMO.split("# Local")[0].replace("   3    4 ", "   3    3 ")
    for first in (1, 2, 3):
        rows = rows.replace(f"\n    {first} ", f"\n    {first - 1} ")
    (tmp_path / "a.aln").write_text(f"Hello\n{rows}")  # as one version of AreTomo3 begins
    with pytest.warns(UserWarning, match="4° about x"):
        series = recon.read_tilt_series(tmp_path / "a.mrc")
    assert series.x_tilt == 4
    np.testing.assert_array_equal(series.images, stack[:3])
    inverted = replace(series, tilt_angles=-series.tilt_angles, x_tilt=-4)
    alignment = recon.read_alignment(tmp_path / "a.aln", inverted)
    assert alignment.apply(inverted).tilt_angles.tolist() == [29, -1, -31]
    assert alignment.x_tilt == -4


@pytest.mark.parametrize("stop", [np.pi / 2, np.pi, 2 * np.pi])
def test_angles_that_look_like_radians_are_pointed_out(stop: float) -> None:
    series = recon.TiltSeries(np.random.default_rng(0).random((20, 8, 9)), np.linspace(0, stop, 20, endpoint=False))
    with pytest.warns(UserWarning, match="radians"):
        recon.prepare(series)


@pytest.mark.parametrize("angles", [[-60.0, -57.0], np.linspace(-60, -57, 13), np.linspace(357, 363, 13)])
def test_degrees_over_a_small_range_are_not_taken_for_radians(angles: Any) -> None:
    assert not as_if_in_radians(np.asarray(angles))


def test_channels_of_arrays_without_names_are_the_shorter_axis(tmp_path: Path) -> None:
    maps = np.random.default_rng(0).integers(0, 9, (7, 2, 8, 9)).astype(np.uint8)
    np.savetxt(tmp_path / "a.TLT", np.arange(7) * 10)  # a suffix of Windows
    for data in (maps, maps.swapaxes(0, 1)):
        np.save(tmp_path / "a.npy", data)
        with pytest.raises(io.SeveralImages) as caught:
            recon.read_tilt_series(tmp_path / "a.npy")
        assert caught.value.names == ("0", "1")
        np.testing.assert_array_equal(recon.read_tilt_series(tmp_path / "a.npy", channel=1).images, maps[:, 1])


def test_image_keys_are_found_beside_a_link_to_the_images(tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "a.nxs", "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"], detector["image_key"] = np.random.default_rng(0).random((7, 8, 9)), [2, 1, 0, 0, 0, 0, 3]
        file["entry/data/data"] = detector["data"]
        file["entry/sample/rotation_angle"] = [0.0, 0, -30, -10, 10, 30, 0]
    assert recon.read_tilt_series(tmp_path / "a.nxs", mask_nan=True).tilt_angles.tolist() == [-30, -10, 10, 30]


def test_the_options_of_files_arrive_in_the_volume(tmp_path: Path, run, refused) -> None:
    from tests.test_formats import mrc_of_type

    stack = mrc_of_type("f4")(tmp_path)
    options = ["--method", "wbp", "--keep-tilts", "--pixel-size", "5", "--exclude-views", "1,12-13"]
    result = run("reconstruct", stack, "-o", tmp_path / "volume.mrc", *options)
    assert result["figures"]["tilts"] == "10, -50° to 40°"
    assert io.read(tmp_path / "volume.mrc").voxel_size == (5, 5, 5)
    for option in (["--exclude-views", "14"], ["--pixel-size", "-1"]):
        assert option[0] in refused("reconstruct", stack, "-o", tmp_path / "other.mrc", *option)


@pytest.mark.parametrize("unit", ["deg", "rad", "mrad", None])
@pytest.mark.parametrize("name", ["angles", "scan/tilt_angle", "exchange/theta"])
def test_angles_of_hdf5_files_by_name_and_unit(name: str, unit: str | None, tmp_path: Path) -> None:
    import h5py

    angles = np.arange(0, 350, 50.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["images"] = np.random.default_rng(0).random((7, 8, 9))
        file[name] = (angles * {"rad": np.pi / 180, "mrad": np.pi / 0.18}.get(unit or "", 1.0))[:, None]
        if unit is not None:
            file[name].attrs["units"] = unit
    np.testing.assert_allclose(recon.read_tilt_series(tmp_path / "a.h5").tilt_angles, angles)


BORDER = np.ones((3, 6, 8), np.bool_)
BORDER[:, :2], BORDER[1, :, 6:] = False, False


def write_mask(path: Path, mask: np.ndarray) -> None:
    """A mask as a program writes it: 0 for pixels to leave out."""
    if path.suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file["mask"] = mask
    elif path.suffix == ".npy":
        np.save(path, mask)
    elif path.suffix == ".npz":
        np.savez(path, mask=mask)
    elif path.suffix == ".png":
        from PIL import Image

        Image.fromarray(mask[0]).save(path)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, mask)  # of one bit
    else:
        io.write(path, mask.astype(np.int8))


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".tif", ".png", ".h5", ".mrc"])
@pytest.mark.parametrize("common", [False, True])
def test_masks_open_from_every_reader(suffix: str, common: bool, tmp_path: Path) -> None:
    if suffix == ".png" and not common:
        pytest.skip("a PNG file holds one image")
    images = np.random.default_rng(0).random(BORDER.shape).astype(np.float32)
    recon.write_tilt_series(tmp_path / "a.mrc", recon.TiltSeries(images, [-30.0, 0.0, 30.0]))
    write_mask(tmp_path / f"mask{suffix}", BORDER[:1] if common else BORDER)
    series = recon.read_tilt_series(tmp_path / "a.mrc", mask=tmp_path / f"mask{suffix}")
    np.testing.assert_array_equal(series.used, np.broadcast_to(BORDER[0], BORDER.shape) if common else BORDER)


def test_a_folder_of_masks_is_joined_by_the_angles_in_names(tmp_path: Path) -> None:
    images = np.random.default_rng(0).random(BORDER.shape).astype(np.float32)
    recon.write_tilt_series(tmp_path / "a.mrc", recon.TiltSeries(images, [-30.0, 0.0, 30.0]))
    folder = folder_of(tmp_path / "m", ["m_-30.0.tif", "m_0.0.tif", "m_30.0.tif"], BORDER.astype(np.uint8))
    assert io.read(folder).tilt_angles.tolist() != [-30, 0, 30]
    np.testing.assert_array_equal(recon.read_tilt_series(tmp_path / "a.mrc", mask=folder).used, BORDER)


def test_a_smaller_image_of_an_ome_file_is_read_by_its_name(tmp_path: Path) -> None:
    haadf = np.random.default_rng(0).random((5, 8, 10)).astype(np.float32)
    counts = np.random.default_rng(1).poisson(2, (5, 4, 5)).astype(np.uint8)
    with tifffile.TiffWriter(tmp_path / "a.ome.tif", ome=True) as file:
        for name, data in (("HAADF", haadf), ("Fe", counts)):
            file.write(data, metadata={"axes": "ZYX", "Name": name}, photometric="minisblack")
    np.testing.assert_array_equal(io.read(tmp_path / "a.ome.tif").data, haadf)
    np.testing.assert_array_equal(io.read(tmp_path / "a.ome.tif", channel="Fe").data, counts)


def test_command_files_of_both_axes_and_lists_of_views_to_use(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 8, 9)).astype(np.float32)
    for axis in "ab":
        io.write(tmp_path / f"s{axis}.ali", stack)
        (tmp_path / f"s{axis}.tlt").write_text("-20\n-10\n10\n20\n")
        command = f"InputProjections s{axis}.ali\nTILTFILE s{axis}.tlt\nOFFSET 2\nINCLUDE 1-2\nINCLUDE 4\n"
        (tmp_path / f"tilt{axis}.com").write_text(command)
        with pytest.warns(UserWarning, match="views 3"):
            assert recon.read_tilt_series(tmp_path / f"s{axis}.ali").tilt_angles.tolist() == [-18, -8, 22]


def test_images_that_a_table_of_sections_leaves_out_are_left_out(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 8, 9)).astype(np.float32)
    io.write(tmp_path / "a.mrc", stack)
    rows = "4@a.mrc 20 nan 3\n1@a.mrc -20 nan 0\n3@a.mrc 10 nan 6\n"
    columns = ("rlnMicrographName", "rlnTomoNominalStageTiltAngle", "rlnTomoYTilt", "rlnMicrographPreExposure")
    names = "".join(f"_{name} #{place}\n" for place, name in enumerate(columns, 1))
    (tmp_path / "a.star").write_text(f"data_a\n\nloop_\n{names}{rows}")
    with pytest.warns(UserWarning, match="3 of 4"):
        series = recon.read_tilt_series(tmp_path / "a.mrc")
    assert series.tilt_angles.tolist() == [-20, 10, 20]
    assert series.dose is not None
    assert series.dose.tolist() == [0, 6, 3]
    np.testing.assert_array_equal(series.images, stack[[0, 2, 3]])


def test_an_mdoc_without_a_section_leaves_its_image_out(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).random((4, 8, 9)).astype(np.float32)
    io.write(tmp_path / "a.mrc", stack)
    sections = "".join(f"[ZValue = {z}]\nTiltAngle = {20 * z - 20}\n" for z in (3, 0, 2))
    (tmp_path / "a.mrc.mdoc").write_text(sections)
    with pytest.warns(UserWarning, match="3 of 4"):
        series = recon.read_tilt_series(tmp_path / "a.mrc")
    assert series.tilt_angles.tolist() == [-20, 20, 40]
    np.testing.assert_array_equal(series.images, stack[[0, 2, 3]])


def test_a_list_inside_a_folder_is_found_by_its_name(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", ["a1.tif", "a2.tif", "a10.tif"], STACK)
    (folder / "tilt_log.txt").write_text("1\n2\n3\n")
    (folder / "tilt_angles.txt").write_text("-9\n0\n9\n")
    series = recon.read_tilt_series(folder)
    assert series.tilt_angles.tolist() == [-9, 0, 9]
    np.testing.assert_array_equal(series.images, STACK)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "a.jpg").touch()
    with pytest.raises(ValueError, match=r"holds \.jpg"):
        io.read(tmp_path / "b")


@pytest.mark.parametrize("suffix", [".gz", ".bz2"])
def test_damaged_packed_files_are_named(suffix: str, tmp_path: Path) -> None:
    import bz2
    import gzip

    packed = (gzip if suffix == ".gz" else bz2).compress(np.random.default_rng(0).bytes(3000))
    for content in (packed[:1000], packed[:300] + bytes(300) + packed[600:], b"nothing packed" * 9):
        (tmp_path / f"a.mrc{suffix}").write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.mrc"):
            io.read(tmp_path / f"a.mrc{suffix}")


def turned_slab(degrees: float) -> np.ndarray:
    """A slab whose z rises with y by an angle."""
    z, y, _ = np.meshgrid(*(np.arange(32) - 15.5 for _ in range(3)), indexing="ij")
    radians = np.deg2rad(degrees)
    return np.clip(3.0 - np.abs(z * np.cos(radians) - y * np.sin(radians)), 0, 1) * (np.abs(y) < 11)


@pytest.mark.parametrize("invert", [False, True])
def test_a_specimen_that_is_turned_about_x_is_written_level(invert: bool, tmp_path: Path, run) -> None:
    series, _ = recon.clean_tilt_series(turned_slab(10.0), np.arange(-90, 90, 9.0))
    recon.write_tilt_series(tmp_path / "a.mrc", series)
    (tmp_path / "a.xtilt").write_text("-10\n" * 20 if invert else "10\n" * 20)
    if invert:
        (tmp_path / "a.rawtlt").write_text("".join(f"{-angle}\n" for angle in series.tilt_angles))
    options = ["--method", "sirt", "--steps", "20", *(["--invert-tilt"] if invert else [])]
    run("reconstruct", tmp_path / "a.mrc", "-o", tmp_path / "v.mrc", *options)
    volume = io.read(tmp_path / "v.mrc").data
    places = np.arange(32) - 15.5
    heights = [float(np.average(places, weights=volume[:, y].sum(1).clip(0))) for y in (9, 22)]
    assert abs(heights[1] - heights[0]) < 0.3  # 2.3 voxels as it was
