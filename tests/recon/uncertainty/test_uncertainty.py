"""Error bars: a posterior that is known is sampled rightly, a wrong noise model is found out, and figures carry intervals."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from scipy.ndimage import binary_erosion, gaussian_filter
from typer.testing import CliRunner

from benchmarks.coverage import left_out_ranks, predictive_ranks, share_within, unseen_part, voxel_coverage
from benchmarks.needle import load as load_needle
from benchmarks.scenes import make_scene
from noiseflow import Gaussian, io
from noiseflow.io.checks import parse_region
from noiseflow.metrics.evaluation import kolmogorov_smirnov
from recon.commands.measure import measure
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers import Regulariser
from recon.joint.signal_model import TomographySignal
from recon.methods import reconstruct
from recon.metrics.metrics import fourier_shell_correlation, resolution
from recon.projection.image_formation import Linear
from recon.projection.projector import SliceProjector
from recon.reconstruction import Reconstruction
from recon.scale.blocks import blocks
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from recon.uncertainty import (
    Posterior,
    ShellBand,
    Uncertainty,
    error_bars,
    line_profile,
    mean_of_region,
    unseen_range,
    volume_above,
    wedge_std,
)
from recon.uncertainty.result import ShellSums
from tests.commands import run_command

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scene():
    density = make_phantom("particles", 16, generator=np.random.default_rng(1), count=10)
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 3.0), acquisition=ACQUISITIONS["clipped"])
    return add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)


def measure_volume(*words):
    app = typer.Typer()
    app.command()(measure)
    result = CliRunner().invoke(app, [*map(str, words), "--json"])
    if result.exception is not None:
        raise result.exception
    return json.loads(result.stdout.splitlines()[-1])


class Nothing(Regulariser):
    def __call__(self, volume, scale):
        return 0 * volume.sum()


def test_spread_of_a_gaussian_posterior_is_that_of_linear_algebra():
    angles, deviation = np.arange(-80, 81, 8.0), 0.05
    projector = SliceProjector(tilt_angles=angles, depth=4, width=4, detector_width=6)
    field = VoxelField((4, 24, 4))
    field.start_from(torch.full((4, 24, 4), 3.0))  # far from zero, where nothing is reflected
    formation = Linear().requires_grad_(False)
    model = TomographySignal(field, projector, formation, regulariser=Nothing(), weight=0.0)
    noise = Gaussian(deviation)
    images = np.ascontiguousarray(model.signal().detach().view(len(angles), 6, 24).numpy().transpose(0, 2, 1))
    outcome = Reconstruction(Volume(model.volume().numpy()), images, "joint", noise, signal_model=model)
    A = projector.project(torch.eye(16)).double()
    chain = Posterior(outcome, TiltSeries(images, angles, mode="linear"), 150)
    stiffness, modes = torch.linalg.eigh(A.T @ A / deviation**2)
    variance = 1 / (stiffness * (1 - chain.step_size * stiffness / 2))  # of a chain of finite steps
    expected = (modes**2 @ variance).sqrt().view(4, 4)
    while chain.done < chain.num_steps:
        chain.step()
    found = torch.from_numpy(chain.result().std.attenuation).square().mean(1).sqrt()
    assert (
        float((found / expected).log().abs().mean()) < 0.15
    )  # a chain of this length is not done with the slackest mode


def test_samples_repeat_themselves_and_go_on_where_they_were(scene):
    outcome = reconstruct(scene, VolumeGrid.of(scene), weight=0.4, num_steps=10)
    whole = Posterior(outcome, scene, 2)
    whole.step()
    kept = {name: each.clone() if torch.is_tensor(each) else each for name, each in whole.state().items()}
    whole.step()
    again = Posterior(outcome, scene, 2)
    again.load_state(kept)
    again.step()
    np.testing.assert_array_equal(whole.result().std.attenuation, again.result().std.attenuation)
    bars = error_bars(outcome, scene, 2)
    np.testing.assert_array_equal(bars.std.attenuation, whole.result().std.attenuation)
    assert (bars.std.attenuation >= 0).all()


@pytest.mark.parametrize("flip", [(), (1,), (2,), (1, 2)])
def test_error_bars_of_a_flipped_series_are_those_of_its_reconstruction(scene, flip):
    flipped = scene.with_images(np.ascontiguousarray(np.flip(scene.images, flip)), None)
    outcome = reconstruct(flipped, weight=0.4, num_steps=5, uncertainty=2)
    bars = error_bars(replace(outcome, uncertainty=None), flipped, 2)
    # a few voxels differ by the last bit of single precision
    np.testing.assert_allclose(bars.std.attenuation, outcome.uncertainty.std.attenuation, rtol=2e-7)
    assert bars.std.attenuation[outcome.volume.attenuation > 0].min() > 0


def test_wrong_noise_model_is_found_out_on_left_out_pixels(scene):
    settings = {"weight": 0.4, "num_steps": 40, "method": "joint"}
    right = left_out_ranks(scene, num_samples=4, noise_model=ACQUISITIONS["clipped"].noise(), **settings)
    wrong = left_out_ranks(scene, num_samples=4, noise_model=Gaussian(0.12), **settings)
    assert 0.87 < share_within(right) < 0.93
    assert kolmogorov_smirnov(right) < 0.05
    assert not 0.87 < share_within(wrong) < 0.93
    assert kolmogorov_smirnov(wrong) > 0.1


def test_ranks_of_what_a_detector_clips_are_uniform():
    noise = ACQUISITIONS["clipped"].noise()
    signal = torch.linspace(0.2, 1.0, 20000)
    ranks = predictive_ranks(noise, signal[None], noise(signal).sample(generator=torch.Generator().manual_seed(0)))
    assert share_within(ranks) == pytest.approx(0.9, abs=0.01)
    assert float(np.abs(np.sort(ranks) - np.linspace(0, 1, ranks.size)).max()) < 1.6 / math.sqrt(ranks.size)


def test_waves_that_no_tilt_saw_are_told_from_those_that_one_did():
    angles = np.arange(-40.0, 61, 5)
    assert unseen_range(angles) == (60, 140)
    z, x = np.indices((32, 32)) - 16
    for degrees, share in ((90, 1), (75, 1), (0, 0), (50, 0), (-35, 0), (130, 1)):
        towards = 6 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        wave = np.cos(2 * np.pi / 32 * (x * round(towards[0]) + z * round(towards[1])))
        volume = np.repeat(wave[:, None], 4, 1)
        np.testing.assert_allclose(unseen_part(1 + volume, angles), share * volume, atol=1e-5)


def test_the_error_in_the_wedge_lies_where_there_is_detail_beside_it():
    angles = np.arange(-60.0, 61, 5)  # the wedge is from 60 to 120 degrees
    z, x = np.indices((48, 48)) - 24
    spread = np.full((48, 2, 48), 0.5)
    for along, shown in (((8, 9), True), ((9, 2), False), ((1, 9), False)):  # only the first wave is beside the wedge
        wave = np.cos(2 * np.pi / 48 * (x * along[0] + z * along[1])) * np.exp(-(np.hypot(z, x - 10) ** 2) / 30)
        volume = 3 + np.repeat(wave[:, None], 2, 1)
        found = wedge_std(volume, spread, 0 * spread, angles)
        if not shown:
            assert np.square(found).sum() < 0.2 * np.square(wave).sum()
            continue
        assert np.unravel_index(found[:, 0].argmax(), wave.shape) == pytest.approx((24, 34), abs=1)
        # at most as much as beside the wedge, and as much as the samples have in it
        assert np.square(found).sum() == pytest.approx(np.square(volume - volume.mean()).sum(), rel=0.1)
        little = wedge_std(volume, 1e-3 * spread, 0 * spread, angles)
        assert np.square(little).sum() == pytest.approx(np.square(1e-3 * spread).sum() / 3, rel=1e-3)
        np.testing.assert_allclose(wedge_std(volume[::-1], spread, 0 * spread, angles)[::-1], found, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shells", "virions"])
def test_error_bars_hold_the_truth_inside_of_objects(kind):
    scene = make_scene(64, phantom=kind, noise="clipped", tilts="-59.5:57.5:1.5")
    found = reconstruct(scene.noisy, scene.grid, method="joint", uncertainty=16)
    inside = binary_erosion(scene.truth > 0.05 * scene.truth.max())
    covered = voxel_coverage(found.volume.attenuation, found.uncertainty, scene.truth)
    assert 0.85 < covered[inside].mean() < 0.95


def test_figures_of_a_volume_carry_intervals(tmp_path):
    values = np.zeros((4, 5, 6), np.float32)
    values[1:3] = 2.0
    bars = Uncertainty(*(Volume(np.full_like(values, part)) for part in (0.2, -0.4, np.sqrt(0.05))), 16)
    whole = parse_region(":,:,:", values.shape)
    mean = mean_of_region(values, parse_region("1:3,:,2:", values.shape), bars)
    assert (mean.value, mean.high - mean.value) == (2.0, pytest.approx(1.6449 * 0.5, rel=1e-3))
    count = volume_above(values, 1.5, whole, bars)
    assert (count.low, count.value, count.high) == (0, 60, 60)
    distance, along, half = line_profile(values, (0, 2, 2), (3, 2, 2), bars)
    np.testing.assert_allclose(along, [0, 2, 2, 0])
    np.testing.assert_allclose(half, 1.6449 * 0.5, rtol=1e-3)
    assert distance[-1] == 3
    for bad in ("1:2", "0:9,:,:", "a:b,:,:"):
        with pytest.raises(ValueError, match="--region"):
            parse_region(bad, values.shape)
    io.write(tmp_path / "v.mrc", values, voxel_size=(10.0, 10.0, 10.0))
    paths = bars.write(tmp_path / "v.mrc")
    assert sorted(path.name for path in paths.values()) == ["v_bias.mrc", "v_std.mrc", "v_wedge.mrc"]


@pytest.mark.parametrize("size", [1, 2, 3, 6, 12, 22])
@pytest.mark.parametrize("alike", [1, 2])
def test_the_mean_of_a_region_is_as_certain_as_errors_of_its_parts_make_it(size: int, alike: int) -> None:
    generator, bias, covered, halves = np.random.default_rng(size), 0.3, [], []
    known = ShellBand(np.linspace(0, 0.5, 13), np.ones(13), np.ones(13))  # voxels are resolved
    parts = [Volume(np.full((24, 24, 24), part, np.float32)) for part in (1.0, bias, 0.5)]
    for _ in range(1000):
        errors = np.hypot(1, 0.5) * generator.normal(size=[24 // alike] * 3)
        volume = bias * generator.choice([-1, 1]) + np.kron(errors, np.ones([alike] * 3))  # the truth is zero
        region = tuple(slice(first, first + size) for first in generator.integers(0, 25 - size, 3))
        found = mean_of_region(volume, region, Uncertainty(*parts, 16, known))
        covered.append(found.low < 0 < found.high)
        halves.append(found.high - found.value)
    bound = mean_of_region(volume, region, Uncertainty(*parts, 16))
    assert np.mean(covered) > 0.87
    assert max(halves) < (bound.high - bound.value) * (1.01 if size == 1 else 0.9 if size < 6 else 0.5)


def test_reconstruct_writes_error_bars_and_measure_reads_them(scene, tmp_path):
    np.save(tmp_path / "tilts.npy", scene.images)
    np.savetxt(tmp_path / "tilts.tlt", scene.tilt_angles)
    options = ["--weight", 0.4, "--steps", 5, "--uncertainty", 2, "--regulariser", "second-order"]
    result = run_command("reconstruct", tmp_path / "tilts.npy", "-o", tmp_path / "v.mrc", *options)
    assert set(result["uncertainty"]) == {"std", "bias", "wedge", "fsc"}
    assert result["choices"]["regulariser"] == "second-order"
    assert io.read(tmp_path / "v_std.mrc").data.shape == (16, 16, 16)
    measured = measure_volume(
        tmp_path / "v.mrc", "--region", "4:12,4:12,4:12", "--above", 0.01, "--line", "8,8,0:8,8,15"
    )
    assert measured["mean"]["low"] < measured["mean"]["value"] < measured["mean"]["high"]
    assert measured["voxels above"]["low"] <= measured["voxels above"]["value"] <= measured["voxels above"]["high"]
    assert len(measured["line"]["high"]) == 16
    low, high = measured["resolution (cycles per voxel)"]
    assert 0 <= low <= high <= 0.5
    (tmp_path / "v_bias.mrc").unlink()
    with pytest.raises(ValueError, match="missing"):
        measure_volume(tmp_path / "v.mrc")


def test_noise_model_of_a_quiet_series_is_as_wide_as_what_the_fit_leaves():
    series = load_needle()
    found = reconstruct(series, method="joint", weight=0.34, num_steps=60)
    signal, seen = (
        torch.from_numpy(np.asarray(each, np.float32).ravel()) for each in (found.projections, series.images)
    )
    bright = signal > signal.quantile(0.8)
    with torch.no_grad():
        width = found.noise_model.model(signal[bright]).variance.mean().sqrt()
    assert 0.5 < float(width / (seen - signal)[bright].std()) < 2
    assert found.caution is None
    assert "not reliable" in replace(found, uncertainty=Uncertainty(*[found.volume] * 3, 2)).caution


@pytest.mark.slow
def test_a_high_weight_does_not_change_the_noise_of_a_quiet_series():
    series = load_needle().rows(slice(28, 40))
    widths = []
    for weight in (50, 400):
        found = reconstruct(series, VolumeGrid.of(series, 64), method="joint", weight=weight, num_steps=20)
        widths.append(float(found.likelihood(torch.zeros(1)).stddev))
    assert widths[1] == pytest.approx(widths[0], rel=0.2)


@pytest.mark.slow
def test_spread_in_blocks_is_that_in_one_go_under_one_noise_model(tmp_path):
    density = make_phantom("particles", 24, generator=np.random.default_rng(1))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 3.0), acquisition=ACQUISITIONS["clipped"])
    noisy = add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)
    settings = {"noise_model": ACQUISITIONS["clipped"].noise(), "weight": 0.4, "uncertainty": 16, "num_steps": 60}
    whole = reconstruct(noisy, method="joint-supervised", **settings).uncertainty
    in_blocks = {"slices_at_once": 6, "scratch": tmp_path / "v.npy"}
    parts = reconstruct(noisy, method="joint-supervised", **settings, **in_blocks).uncertainty
    inside = density > 0.05 * density.max()
    assert parts.std.attenuation[inside].mean() == pytest.approx(whole.std.attenuation[inside].mean(), rel=0.05)
    fine = slice(3, None)  # of the coarsest shells a block of so few slices sees little
    np.testing.assert_allclose(parts.shells.high[fine], whole.shells.high[fine], atol=0.1)
    np.testing.assert_allclose(parts.shells.low[fine], whole.shells.low[fine], atol=0.2)


def test_a_new_volume_without_error_bars_does_not_keep_those_of_the_old(scene, tmp_path):
    np.save(tmp_path / "tilts.npy", scene.images)
    np.savetxt(tmp_path / "tilts.tlt", scene.tilt_angles)
    options = ["reconstruct", tmp_path / "tilts.npy", "-o", tmp_path / "v.mrc", "--weight", 0.4, "--steps", 5]
    result = run_command(*options, "--uncertainty", 2)
    assert all(Path(path).exists() for path in result["uncertainty"].values())
    run_command(*options)
    assert {path.name for path in tmp_path.glob("v*")} == {"v.mrc", "v.mrc.options.toml"}


def test_a_volume_whose_name_looks_like_an_error_bar_is_neither_removed_nor_overwritten(scene, tmp_path):
    np.save(tmp_path / "tilts.npy", scene.images)
    np.savetxt(tmp_path / "tilts.tlt", scene.tilt_angles)
    options = ["--method", "sirt", "--steps", 2]
    run_command("reconstruct", tmp_path / "tilts.npy", "-o", tmp_path / "v_std.mrc", *options)
    run_command("reconstruct", tmp_path / "tilts.npy", "-o", tmp_path / "v.mrc", *options)
    assert (tmp_path / "v_std.mrc").exists()
    (tmp_path / "tilts.tlt").rename(tmp_path / "w_std.tlt")
    (tmp_path / "tilts.npy").rename(tmp_path / "w_std.npy")
    with pytest.raises(ValueError, match="w_std"):
        run_command("reconstruct", tmp_path / "w_std.npy", "-o", tmp_path / "w.npy", *options)


def test_shell_band_is_that_of_known_samples(tmp_path):
    """The samples' mean is the volume less half of it, and each adds noise of the same power in every shell."""
    generator = torch.Generator().manual_seed(0)
    volume = torch.randn(24, 24, 24, generator=generator)
    sums = ShellSums(volume)
    samples = [0.5 * volume + torch.randn(volume.shape, generator=generator) for _ in range(40)]
    for sample in samples:
        sums.add(sample)
    band = ShellBand.of(sums.powers())
    np.testing.assert_allclose(band.high[4:], (1 / 2) ** 0.5, atol=0.03)  # the volume and noise as strong
    np.testing.assert_allclose(band.low[4:], (0.25 / 1.25) ** 0.5, atol=0.1)  # a twentieth quantile: below the mean
    assert (band.low[4:] < (0.25 / 1.25) ** 0.5 + 0.01).all()
    band.write(tmp_path / "v_fsc.csv")
    np.testing.assert_allclose(ShellBand.read(tmp_path / "v_fsc.csv").low, band.low, rtol=1e-5)
    (tmp_path / "v_fsc.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="not a table"):
        ShellBand.read(tmp_path / "v_fsc.csv")
    assert ShellBand.of(ShellSums(volume[:3]).powers()) is None


@pytest.mark.parametrize(
    ("height", "slices_at_once", "halo"), [(64, 16, 6), (23, 6, 12), (50, 7, 12), (9, 3, 12), (10, 4, 0)]
)
def test_squares_of_the_shares_of_blocks_add_up_to_one(height, slices_at_once, halo):
    shares = np.zeros(height)
    for part in blocks(height, slices_at_once, halo):
        shares[part.wide] += part.shares() ** 2
    np.testing.assert_allclose(shares, 1, rtol=1e-6)


def test_shell_band_of_blocks_is_that_of_the_whole():
    generator, parts = torch.Generator().manual_seed(0), blocks(64, 16, 6)
    volume = torch.from_numpy(gaussian_filter(np.random.default_rng(0).normal(size=(64, 64, 64)), 1.5)).float()
    noise = 0.5 * float(volume.std())
    whole = ShellSums(volume)
    sums = [
        ShellSums(volume[:, part.wide], shares=torch.from_numpy(part.shares()), height=part.height) for part in parts
    ]
    for _ in range(6):
        sample = volume + noise * torch.randn(volume.shape, generator=generator)
        whole.add(sample)
        for part, one in zip(parts, sums, strict=True):
            one.add(sample[:, part.wide])
    added = np.sum([one.powers() for one in sums], axis=0)
    assert added[-2].sum() == pytest.approx(whole.powers()[-2].sum(), rel=0.02)
    band, known = ShellBand.of(added), ShellBand.of(whole.powers())
    for found, told in ((band.low, known.low), (band.high, known.high)):
        np.testing.assert_allclose(found[3:], told[3:], atol=0.06)


def test_shell_band_of_a_fit_holds_the_correlation_with_the_truth(tmp_path):
    density = make_phantom("particles", 32, generator=np.random.default_rng(1))
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 3.0), acquisition=ACQUISITIONS["clipped"])
    noisy = add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)
    found = reconstruct(noisy, weight=0.34, method="joint", uncertainty=8)  # as it would choose
    band = found.uncertainty.shells
    frequency, correlation = fourier_shell_correlation(found.volume.attenuation, density * unit)
    np.testing.assert_allclose(band.frequency, frequency)
    told = correlation > 0.5  # shells that a reader would trust, and the first is the mean
    inside = (band.low <= correlation) & (correlation <= band.high)
    assert inside[told][1:].mean() > 0.7  # 90 % is stated; shells of one volume err together
    assert (band.low <= correlation)[told][1:].all()  # it never promises more than there is
    assert band.resolution()[0] < resolution(frequency, correlation, 0.5)
    for name, values in (("v", found.volume.attenuation), ("truth", density * unit)):
        io.write(tmp_path / f"{name}.mrc", values.astype(np.float32))
    found.uncertainty.write(tmp_path / "v.mrc")
    compared = run_command("compare", tmp_path / "v.mrc", tmp_path / "truth.mrc")
    np.testing.assert_allclose(compared["fsc_expected"]["low"], band.low, atol=1e-5)
