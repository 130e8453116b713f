"""Several channels of one series: one alignment, one volume and noise model each."""

import warnings

import numpy as np
import pytest

import recon
from noiseflow import io
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import TiltSeries
from tests.recon.series.test_alignment import ANGLES, blobs, random_shifts


def element(weights, shifts):
    """Counts of an element that two of four blobs hold, misaligned like the HAADF images."""
    haadf = blobs(3.0, shifts, shape=(24, 24)).images
    return (
        np.random.default_rng(int(weights)).poisson(np.clip(haadf, 0, None) * weights / haadf.mean()).astype(np.uint16)
    )


@pytest.fixture
def maps(tmp_path):
    shifts = random_shifts(2.0)
    haadf = blobs(3.0, shifts, shape=(24, 24)).images
    np.save(tmp_path / "haadf.npy", haadf)
    np.save(tmp_path / "iron.npy", element(1, shifts))
    np.save(tmp_path / "oxygen.npy", element(2, shifts)[::-1])
    for name, angles in (("haadf", ANGLES), ("iron", ANGLES), ("oxygen", ANGLES[::-1])):
        np.savetxt(tmp_path / f"{name}.tlt", angles)
    return tmp_path


def test_maps_take_the_alignment_of_another_channel(maps):
    series = {}
    for name in ("haadf", "iron", "oxygen"):
        series[name] = recon.read_tilt_series(maps / f"{name}.npy", mode="linear")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = recon.prepare_channels(
            {name: series[name] for name in ("iron", "oxygen")}, align_on=series["haadf"], refine_alignment=True
        )
        alone = recon.prepare(series["haadf"], refine_alignment=True)
    np.testing.assert_array_equal(found["iron"].alignment.shifts, alone.alignment.shifts)
    np.testing.assert_array_equal(found["oxygen"].alignment.shifts, alone.alignment.shifts[::-1])
    np.testing.assert_array_equal(found["oxygen"].tilt_series.tilt_angles, alone.tilt_series.tilt_angles)
    aligned = [each.tilt_series.images.sum((1, 2), dtype=np.float64) for each in found.values()]
    assert (
        np.corrcoef(*(image.images.mean(0).ravel() for image in (alone.tilt_series, found["oxygen"].tilt_series)))[0, 1]
        > 0.95
    )
    assert len(aligned[0]) == len(aligned[1])
    assert {each.tilt_series.images.dtype for each in found.values()} == {np.dtype(np.uint16)}  # counts stay Poisson


def test_the_sum_needs_equal_tilts(maps):
    iron, oxygen = (recon.read_tilt_series(maps / f"{name}.npy", mode="linear") for name in ("iron", "oxygen"))
    with pytest.raises(ValueError, match="--align-on"):
        recon.prepare_channels({"iron": iron, "oxygen": oxygen})
    few = TiltSeries(iron.images, iron.tilt_angles + 1.7, mode="linear")
    with pytest.raises(ValueError, match="channel iron: the alignment has no tilt"):
        recon.prepare_channels({"iron": few}, align_on=oxygen)


@pytest.mark.slow
def test_one_volume_for_each_element_and_one_report(maps, run):
    command = ["reconstruct", maps / "iron.npy", maps / "oxygen.npy", "-o", maps / "v.mrc", "--mode", "linear"]
    more = ["--align-on", maps / "haadf.npy", "--refine-alignment", "--method", "sirt", "--report", maps / "report"]
    found = run(*command, *more, "--save-alignment", maps / "a.json")
    assert set(found["channels"]) == {"iron", "oxygen"}
    shapes = {io.read(maps / f"v_{name}.mrc").data.shape for name in ("iron", "oxygen")}
    assert len(shapes) == 1
    page = (maps / "report" / "index.html").read_text(encoding="utf-8")
    assert "iron" in page
    assert "oxygen" in page
    again = run(
        "reconstruct",
        maps / "iron.npy",
        "-o",
        maps / "w.mrc",
        "--mode",
        "linear",
        "--method",
        "sirt",
        "--alignment",
        maps / "a.json",
    )
    np.testing.assert_allclose(
        again["alignment"]["shifts_yx_pixels"], found["channels"]["iron"]["alignment"]["shifts_yx_pixels"]
    )


def test_all_channels_of_a_hyperstack(tmp_path, run):
    import tifffile

    volume = np.zeros((2, 16, 16, 16), np.float32)
    volume[0, 5:9, 5:9, 5:9], volume[1, 8:12, 6:10, 4:8] = 1, 1
    angles = np.arange(-60, 61, 10.0)
    projector = SliceProjector(tilt_angles=angles, depth=16, width=16)
    images = np.stack([projector(each) for each in volume], 1)  # (tilt, channel, y, x)
    tifffile.imwrite(tmp_path / "maps.tif", images, imagej=True, metadata={"axes": "ZCYX"})
    np.savetxt(tmp_path / "maps.tlt", angles)
    command = ["reconstruct", tmp_path / "maps.tif", "-o", tmp_path / "v.mrc", "--mode", "linear", "--method", "sirt"]
    found = run(*command, "--steps", "30", "--channel", "all")
    assert len(found["channels"]) == 2
    for (name, result), truth in zip(found["channels"].items(), volume, strict=True):
        assert recon.compare(io.read(result["volume"]).data, truth).psnr > 20, name


def test_align_on_needs_several_channels(maps):
    from tests.commands import run_command

    command = ["reconstruct", maps / "iron.npy", "-o", maps / "v.mrc", "--mode", "linear"]
    with pytest.raises(ValueError, match="several channels"):
        run_command(*command, "--align-on", maps / "haadf.npy")
    with pytest.raises(ValueError, match="named iron"):
        run_command(command[0], maps / "iron.npy", *command[1:])
