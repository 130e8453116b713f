"""Blocks of slices: the same volume as in one go, in the memory of one block."""

import tracemalloc
from dataclasses import replace
from itertools import combinations

import mrcfile
import numpy as np
import pytest

from noiseflow import io
from noiseflow.io.mapped import create_volume, finish_volume, is_mapped
from noiseflow.runs.ownership import is_own
from recon.methods import reconstruct
from recon.scale.blocks import HALO
from recon.series.alignment import Alignment
from recon.series.files import read_tilt_series, write_tilt_series
from recon.series.first_guess import invert_contrast
from recon.series.orientation import Orientation
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series


@pytest.fixture(scope="module")
def scene():
    density = make_phantom("shells", 28, generator=np.random.default_rng(1), count=10)
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 6.0))
    return density * unit, add_noise(clean, ACQUISITIONS["skewed"].noise(), seed=2)


@pytest.mark.parametrize(("method", "settings"), [("sirt", {"num_steps": 12}), ("wbp", {"window": "hann"})])
@pytest.mark.parametrize("rows", [1, 5, 100])
def test_blocks_of_independent_slices_give_the_same_volume(scene, tmp_path, method, settings, rows):
    _, noisy = scene
    grid = VolumeGrid.of(noisy, thickness=20)
    whole = reconstruct(noisy, grid, method=method, **settings)
    blocks = reconstruct(noisy, grid, scratch=tmp_path / "v.npy", method=method, slices_at_once=rows, **settings)
    np.testing.assert_allclose(blocks.volume.attenuation, whole.volume.attenuation, atol=1e-6)
    np.testing.assert_allclose(blocks.projections, whole.projections, atol=1e-5)
    np.testing.assert_array_equal(np.load(tmp_path / "v.npy"), blocks.volume.attenuation)


def test_memory_mapped_series_is_read_block_by_block(scene, tmp_path):
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    with mrcfile.mmap(tmp_path / "tilts.mrc") as file:
        mapped = TiltSeries(file.data, noisy.tilt_angles)
        assert np.shares_memory(mapped.images, file.data)
        options = {"method": "wbp", "window": "hann", "slices_at_once": 8}
        found = reconstruct(mapped, VolumeGrid.of(mapped), scratch=tmp_path / "v.npy", **options)
    whole = reconstruct(noisy, VolumeGrid.of(noisy), method="wbp", window="hann")
    np.testing.assert_allclose(found.volume.attenuation, whole.volume.attenuation, atol=1e-6)


@pytest.mark.slow
def test_fitted_blocks_differ_from_one_go_by_no_more_than_another_choice_of_held_out_pixels(scene, tmp_path):
    _, noisy = scene
    options = {"method": "l2", "weight": 0.5, "num_steps": 60}
    whole, blocks = (
        [
            reconstruct(
                noisy, scratch=tmp_path / f"{rows}-{seed}.npy", slices_at_once=rows, seed=seed, **options
            ).volume.attenuation
            for seed in range(3)
        ]
        for rows in (28, 10)
    )

    def apart(pairs):  # of one pair it depends on the seed by a third
        return np.mean([np.sqrt(np.mean((one - other) ** 2)) for one, other in pairs])

    assert apart(zip(blocks, whole, strict=True)) < 1.5 * apart(combinations(whole, 2))


def test_command_streams_and_leaves_nothing_behind(scene, tmp_path, run, refused):
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    command = ["reconstruct", tmp_path / "tilts.mrc", "-o", tmp_path / "v.mrc", "--method", "wbp", "--window", "hann"]
    run(*command)
    whole = mrcfile.read(tmp_path / "v.mrc")
    run(*command, "--slices-at-once", 6)
    np.testing.assert_allclose(mrcfile.read(tmp_path / "v.mrc"), whole, atol=1e-6)
    assert {path.name for path in tmp_path.iterdir()} == {*("tilts.mrc", "tilts.rawtlt", "v.mrc", "v.mrc.options.toml")}
    command[command.index("wbp")] = "wbp-denoised"
    assert "--slices-at-once" in refused(*command, "--slices-at-once", 6)


@pytest.fixture
def tall(tmp_path):
    """A series of 27 MiB, of few columns, on the disk."""
    generator = np.random.default_rng(0)
    angles = np.arange(-60, 61, 8.0)
    stack = np.exp(-generator.uniform(0, 1, (len(angles), 14000, 32)).astype(np.float32) / 4)
    stack[:, :, 12:20] *= 0.5
    write_tilt_series(tmp_path / "tall.mrc", TiltSeries(stack, angles))
    return tmp_path / "tall.mrc"


@pytest.mark.parametrize("name", ["v.npy", "v.mrc"])
def test_command_holds_one_block_in_memory(tall, tmp_path, run, name, monkeypatch):
    """Neither images nor volume nor projections, of 27, 55 and 27 MiB, are ever whole in memory; the verdict takes 18 MiB."""
    monkeypatch.setattr("noiseflow.io.mapped.IN_MEMORY", 2**20)  # of the size from which copies go to files
    command = ["reconstruct", tall, "-o", tmp_path / name, "--method", "sirt", "--steps", 2]
    command += ["--slices-at-once", 14000 // 8]
    peaks = []
    for _ in range(2):  # imports count in the first run
        tracemalloc.start()
        run(*command)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 26 * 2**20


def test_mapped_stack_is_left_on_the_disk_and_unchanged(scene, tmp_path):
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    before = (tmp_path / "tilts.mrc").read_bytes()
    mapped = read_tilt_series(tmp_path / "tilts.mrc", mapped=True)
    np.testing.assert_array_equal(mapped.images, noisy.images)
    mapped.images[0, 0, 0] = 7.0
    assert (tmp_path / "tilts.mrc").read_bytes() == before
    for name in ("one.npy", "one.mrc"):
        io.write(tmp_path / name, noisy.images)
        assert isinstance(io.read(tmp_path / name, mapped=True).data, np.memmap)
        assert not isinstance(io.read(tmp_path / name).data, np.memmap)


def test_what_lies_beyond_a_block_reaches_into_it(scene, tmp_path):
    """The regulariser sees across the borders of blocks: as in one go, the slices there follow their neighbours outside."""
    _, noisy = scene
    series = replace(noisy, images=noisy.images[:, :16])
    grid = VolumeGrid.of(series)
    part = series.images[:, 8:10]
    changed = series.images.copy()
    changed[:, 8:10] = part.mean() - 0.5 * (part - part.mean())
    # settled on the same slab, the same noise and intensity: only the neighbours differ
    options = {"method": "tv", "weight": 3.0, "num_steps": 20, "slices_at_once": 8}
    volumes = []
    for name, images in (("as-it-is", series.images), ("changed", changed)):
        found = reconstruct(replace(series, images=images), grid, scratch=tmp_path / f"{name}.npy", **options)
        volumes.append(found.volume.attenuation)
    difference = np.sqrt(np.mean((volumes[1] - volumes[0]) ** 2, axis=(0, 2)))
    assert difference[7] > 0.2 * difference[8]


def test_tilts_of_a_large_mapped_series_in_any_order_stay_on_the_disk(scene, tmp_path, monkeypatch):
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    series = read_tilt_series(tmp_path / "tilts.mrc", mapped=True)
    chosen = np.array([5, 2, 9, 3])
    assert not is_mapped(series.select(chosen).images)
    monkeypatch.setattr("noiseflow.io.mapped.IN_MEMORY", 0)
    found = series.select(chosen)
    assert is_mapped(found.images)
    np.testing.assert_array_equal(found.images, noisy.images[chosen])
    np.testing.assert_array_equal(found.tilt_angles, noisy.tilt_angles[chosen])


PREPARED = {
    "masked": lambda path, masked: read_tilt_series(path, mask=masked, mapped=True),
    "aligned": lambda path, _: Alignment(3.0, np.full((21, 2), 0.5), np.arange(-60, 61, 6.0)).apply(
        read_tilt_series(path, mapped=True)
    ),
    "contrast inverted": lambda path, _: invert_contrast(read_tilt_series(path, mapped=True)),
    "masked and flipped": lambda path, masked: Orientation(upside_down=True).series(
        read_tilt_series(path, mask=masked, mapped=True)
    ),
}


@pytest.mark.filterwarnings(
    "ignore:aligned images show:UserWarning"
)  # the alignment moves parts out of the frame on purpose
@pytest.mark.parametrize("way", PREPARED)
def test_a_large_series_that_is_changed_before_the_fit_goes_to_a_file(scene, tmp_path, monkeypatch, way):
    _, noisy = scene
    path, masked = tmp_path / "tilts.mrc", np.random.default_rng(0).random(noisy.images.shape) < 0.95
    write_tilt_series(path, noisy)
    path.with_suffix(".xf").write_text("1 0.01 -0.01 1 0.5 2\n" * noisy.num_tilts)
    small = PREPARED[way](path, masked)
    assert not isinstance(small.images, np.memmap) or not small.images.flags.writeable or way == "masked and flipped"
    monkeypatch.setattr("noiseflow.io.mapped.IN_MEMORY", 0)
    large = PREPARED[way](path, masked)
    assert is_mapped(large.images)
    np.testing.assert_array_equal(large.images, small.images)
    np.testing.assert_array_equal(large.used, small.used)
    if small.mask is not None:
        assert is_mapped(large.mask)


def test_the_dark_level_of_linear_images_is_taken_off_blocks_and_put_back_once(tmp_path):
    density = make_phantom("shells", 28, generator=np.random.default_rng(1), count=10)
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 6.0))
    integrals = -np.log(clean.images.astype(np.float64))
    images = integrals + 0.01 * integrals.max() * np.random.default_rng(2).standard_normal(integrals.shape)
    series = replace(clean, images=(images + 300 * images.max()).astype(np.float32), mode="linear")
    contrast = float(np.ptp(series.images))
    options = {"method": "l2", "weight": 0.5, "num_steps": 20}
    whole = reconstruct(series, **options)
    kept = tmp_path / "blocks"
    for name in ("first", "resumed"):
        blocks = reconstruct(
            series, scratch=tmp_path / f"{name}.npy", slices_at_once=14, keep=lambda _: kept, **options
        )
        difference = blocks.projections - whole.projections
        assert abs(float(np.median(difference))) < 0.05 * contrast  # the level is 300 times it
        assert np.sqrt(np.mean(difference**2)) < 0.05 * contrast
        np.testing.assert_allclose(blocks.response["offset"], whole.response["offset"], atol=0.05 * contrast)


def test_even_and_odd_tilts_are_reconstructed_in_blocks_too(scene, tmp_path, run):
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    said = {}
    for name, options in (("whole", ()), ("blocks", ("--slices-at-once", 9))):
        command = [
            "reconstruct",
            tmp_path / "tilts.mrc",
            "-o",
            tmp_path / f"{name}.mrc",
            "--method",
            "wbp",
            "--window",
            "hann",
        ]
        run(*command, *options, "--fsc", "--report", tmp_path / name)
        page = (tmp_path / name / "index.html").read_text(encoding="utf-8")
        said[name] = page[page.index("Between even and odd tilts") :][:120]
    assert said["blocks"] == said["whole"]
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []


def test_indices_are_wider_where_there_are_more_than_32_bits_count():
    from recon.projection.base import index_type

    assert index_type(2**31 - 1, 5) is np.int32
    assert index_type(5, 2**31) is np.int64


@pytest.mark.parametrize("name", ["v.npy", "v.mrc"])
def test_a_volume_that_is_filled_part_by_part_is_a_whole_file(tmp_path, name):
    part = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    volume = create_volume(tmp_path / name, part.shape, (2.0, 2.0, 2.0))
    volume[:] = part
    finish_volume(tmp_path / name, volume)
    found = io.read(tmp_path / name)
    np.testing.assert_array_equal(found.data, part)
    assert is_own(tmp_path / name)
    assert found.voxel_size == ((2.0, 2.0, 2.0) if name == "v.mrc" else None)


def test_error_bars_of_blocks_share_what_is_settled_and_fade_like_the_volume(scene, tmp_path):
    _, noisy = scene
    noisy = Orientation.of(noisy).series(noisy)  # as blocks are kept
    options = {"method": "l2", "weight": 0.5, "num_steps": 6, "uncertainty": 2, "slices_at_once": 14}
    kept = tmp_path / "blocks"
    found = reconstruct(noisy, scratch=tmp_path / "v.mrc", keep=lambda prefix: kept, **options)
    assert {path.name for path in tmp_path.glob("v*")} == {"v.mrc", "v_std.mrc", "v_bias.mrc", "v_wedge.mrc"}
    assert found.uncertainty.num_samples == 2
    share = ((np.arange(8) + 0.5) / 8)[:, None]  # four slices on either side of the border at 14
    for name, part in (("std", found.uncertainty.std), ("bias", found.uncertainty.bias), ("volume", found.volume)):
        assert is_mapped(part.attenuation)
        below, above = (np.load(path) for path in sorted(kept.glob(f"{name}-*")))
        assert below.shape[1] == above.shape[1] == 14 + HALO
        values = part.attenuation
        above = above[:, HALO - 4 :]  # from slice 10 on
        np.testing.assert_array_equal(values[:, :10], below[:, :10])
        np.testing.assert_array_equal(values[:, 18:], above[:, 8:])
        mixed = (1 - share) * below[:, 10:18] + share * above[:, :8]
        np.testing.assert_allclose(values[:, 10:18], mixed, atol=1e-6)
        assert below.any()
        assert above.any()
    resumed = reconstruct(
        noisy, scratch=tmp_path / "w.mrc", keep=lambda prefix: kept, **options
    )  # finished blocks are taken
    for one, other in zip(resumed.uncertainty.parts.values(), found.uncertainty.parts.values(), strict=True):
        assert other.attenuation.any()
        np.testing.assert_array_equal(one.attenuation, other.attenuation)


@pytest.mark.slow
def test_workers_make_the_error_bars_of_one_process(scene, tmp_path, run):
    pytest.importorskip("dask.distributed", reason="needs the extra [distributed]")
    _, noisy = scene
    write_tilt_series(tmp_path / "tilts.mrc", noisy)
    command = [
        "reconstruct",
        tmp_path / "tilts.mrc",
        "--method",
        "l2",
        "--weight",
        0.5,
        "--steps",
        4,
        "--uncertainty",
        2,
    ]
    run(*command, "--slices-at-once", 14, "-o", tmp_path / "alone.mrc")
    run(*command, "--slices-at-once", 14, "--workers", 1, "-o", tmp_path / "dask.mrc")
    for name in ("", "_std", "_bias", "_wedge"):
        found, expected = (mrcfile.read(tmp_path / f"{run}{name}.mrc") for run in ("dask", "alone"))
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert expected.any()
