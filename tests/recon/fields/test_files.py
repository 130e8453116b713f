"""Fields by name, in files, on other grids, and through whole runs."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import recon
from noiseflow import Gaussian, io
from recon.fields import field_names, find_field, load_field, save_field
from recon.fields.fields import field_kinds
from recon.joint.joint import JointReconstructor
from recon.joint.plan import Schedule
from recon.joint.run import run_fit
from recon.joint.signal_model import TomographySignal
from recon.methods import method_names, reconstruct, settings_of
from recon.methods.joint import choose_field
from recon.scale.memory import needed_memory
from recon.series.files import write_tilt_series
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import add_noise, clean_tilt_series
from tests.independent_scenes import independent_series

KINDS = [name for name in field_names() if name != "auto"]
TOGETHER = ["grids", "gaussians", "network"]


@pytest.fixture(scope="module")
def series():
    """Two shells of different size, so that every flip shows."""
    density = make_phantom("shells", 16, generator=np.random.default_rng(1), count=2)
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 12.0))
    noisy = add_noise(clean, Gaussian(0.3 * float(clean.images.std())), seed=0)
    return TiltSeries(noisy.images, noisy.tilt_angles, 4.0, noisy.mode)


def test_every_field_is_found_by_name():
    assert {"grids", "voxels", "network", "gaussians", "auto"} <= set(field_names())
    assert all(issubclass(find_field(name), recon.Field) for name in KINDS)
    for wrong in ("nerf", "auto"):
        with pytest.raises(ValueError, match="--field"):
            find_field(wrong)
    with pytest.raises(ValueError, match="--field nerf"):
        settings_of("joint", field="nerf")
    with pytest.raises(ValueError, match="--field: method tv"):
        settings_of("tv", field="network")


@pytest.mark.parametrize("name", KINDS)
def test_field_survives_its_file(name, tmp_path):
    torch.manual_seed(0)
    field = find_field(name)((6, 8, 10), scale=0.3)
    field.start_from(torch.rand(3, 4, 5))
    field.occupied = torch.rand(6, 10, 8) > 0.5
    field.voxel_size, field.flipped, field.margin = 2.5, (0, 2), 1
    save_field(field, tmp_path / "field.safetensors")
    again = load_field(tmp_path / "field.safetensors")
    assert torch.equal(again.volume(), field.volume())
    assert (again.voxel_size, again.flipped, again.margin) == (2.5, (0, 2), 1)
    point = torch.tensor([[2.5, 9.0, 14.2]])
    torch.testing.assert_close(again.at(point, unit="Å"), field.at(point, unit="Å"))


def test_points_are_in_either_sign_for_angstrom():
    field = find_field("grids")((4, 6, 8))
    field.voxel_size = 2.0
    points = torch.tensor([[2.0, 4.0, 6.0]])
    for sign in ("\u00c5", "\u212b"):  # of keyboards, and of tables of characters
        torch.testing.assert_close(field.at(points, unit=sign), field.at(points / 2))


def test_files_that_are_no_fields_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_field(tmp_path / "none.safetensors")
    import noiseflow

    noiseflow.save(Gaussian(), tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="not a field"):
        load_field(tmp_path / "model.safetensors")
    (tmp_path / "field.safetensors").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="damaged"):
        load_field(tmp_path / "field.safetensors")

    class Own(recon.VoxelField):
        pass

    with pytest.raises(ValueError, match="Own is not a named field"):
        save_field(Own((2, 2, 2)), tmp_path / "own.safetensors")


@pytest.mark.parametrize(("name", "turn"), [("grids", True), ("gaussians", False), ("network", True)])
def test_the_field_of_a_result_is_its_volume(series, name, turn):
    if turn:
        series = TiltSeries(series.images[:, ::-1, ::-1].copy(), series.tilt_angles, 4.0, series.mode)
    options = {"noise_model": Gaussian(0.02), "weight": 0.3, "num_steps": 4, "field": name}
    result = reconstruct(series, method="joint", **options)
    assert result.choices["field"] == name
    volume = torch.from_numpy(result.volume.attenuation)
    torch.testing.assert_close(result.field.volume(), volume, rtol=1e-4, atol=1e-6)
    points = torch.tensor([[8.0, 5.0, 3.0], [3.0, 9.0, 12.0], [11.0, 12.0, 7.0]])
    here = volume[tuple(points.long().T)]
    torch.testing.assert_close(result.field.at(4.0 * points, unit="Å").detach(), here, rtol=1e-3, atol=1e-6)
    fine = result.sampled(2.0)
    assert (fine.attenuation.shape, fine.voxel_size) == ((32, 32, 32), 2.0)
    assert float(fine.attenuation.sum()) == pytest.approx(4 * float(volume.sum()), rel=0.1)


@pytest.mark.slow
def test_a_field_that_goes_beyond_the_images_keeps_to_the_volume(tmp_path):
    series = replace(independent_series("truncated_object", "Poisson 40, read noise", "±60°/2°").series, pixel_size=4.0)
    result = reconstruct(series, method="l2", weight=1.5, num_steps=4)
    assert result.field.margin > 0
    save_field(result.field, tmp_path / "field.safetensors")
    field, volume = load_field(tmp_path / "field.safetensors"), torch.from_numpy(result.volume.attenuation)
    torch.testing.assert_close(field.volume(), volume, rtol=1e-4, atol=1e-6)
    points = torch.tensor([[12.0, 5.0, 0.0], [11.0, 9.0, volume.shape[2] - 1.0]])
    torch.testing.assert_close(field.at(points).detach(), volume[tuple(points.long().T)], rtol=1e-3, atol=1e-6)
    assert result.sampled(2.0).attenuation.shape == tuple(2 * size for size in volume.shape)


def test_auto_takes_the_field_that_predicts_best(series):
    options = {"noise_model": Gaussian(0.02), "weight": 0.3, "num_steps": 4, "field": "auto"}
    result = reconstruct(series, method="joint", **options)
    told = result.choices["field"]
    assert type(result.field) is find_field(told.split()[0])
    assert all(name in told for name in TOGETHER)
    assert f"{series.images.shape[1]} slices" in told


@pytest.mark.parametrize(
    ("behind", "chosen"), [((0, 0.1, 0.1), "grids"), ((0, 0.1, 0.0002), "network"), ((0.1, 0, 0.1), "gaussians")]
)
def test_of_fields_that_held_out_pixels_do_not_distinguish_the_last_is_taken(series, monkeypatch, behind, chosen):
    kinds, scatter = field_kinds("auto"), torch.randn(3, 5000, generator=torch.Generator().manual_seed(0))
    scores = {kind: 0.05 * own - less for kind, own, less in zip(kinds.values(), scatter, behind, strict=True)}

    def judged(fit, tilt_series, grid, *, held_out, progress):
        assert list(tilt_series.tilt_angles[held_out.groups > 0]) == [-60, 60]
        return (
            SimpleNamespace(likelihood=None, noise_model=None, weight=0.1),
            scores[fit.make_field],
            torch.arange(5000),
        )

    monkeypatch.setattr(JointReconstructor, "judged", judged)
    name, evidence = choose_field(JointReconstructor(), series, VolumeGrid.of(series), kinds)
    assert name == chosen == evidence.split()[0]
    scatter = 0.05 * math.sqrt(2 / 5000)  # of the difference between any two fields
    assert evidence.count(f"± {scatter:.4f}") == len(kinds) - 1


def test_choices_are_made_with_grids_for_every_field(series):
    weights = {}

    def watched(name, noise_model, signal, observation, **options):
        if isinstance(signal, TomographySignal):
            weights.setdefault(type(signal.field), set()).add(signal.weight)
        return run_fit(name, noise_model, signal, observation, **options)

    grids, network = find_field("grids"), find_field("network")
    schedule = Schedule(settle=2, adapt=2, trial=2)
    fit = JointReconstructor(make_field=network, num_steps=4, schedule=schedule, run_fit=watched)
    result = replace(fit, noise_model=lambda: Gaussian(0.02).requires_grad_(False))(series)
    assert type(result.field) is network
    assert set(result.weights_tried) <= weights[grids]
    assert weights[network] == {result.weight}
    assert result.weight == pytest.approx(result.weight_choice.weight * network.relative_weight)


def test_a_field_goes_through_blocks_and_error_bars(series, tmp_path):
    options = {"noise_model": Gaussian(0.02), "weight": 0.3, "num_steps": 4, "uncertainty": 2}
    for name in ("gaussians", "network"):
        scratch = tmp_path / f"{name}.npy"
        result = reconstruct(series, method="joint", field=name, slices_at_once=8, scratch=scratch, **options)
        assert result.uncertainty.std.attenuation.shape == (16, 16, 16)
        assert result.field is None
        with pytest.raises(ValueError, match="in blocks"):
            result.sampled(2.0)


def test_grids_of_other_voxels_are_refused_by_every_method(series):
    finer = VolumeGrid(32, 32, 32, 2.0)
    for name in method_names():
        settings = {"noise_model": Gaussian(0.02)} if name == "joint-supervised" else {}
        with pytest.raises(ValueError, match="32 voxels high"):
            reconstruct(series, finer, method=name, **settings)
    with pytest.raises(ValueError, match="2 Å"):
        reconstruct(series, VolumeGrid(16, 16, 16, 2.0), method="sirt")


def test_methods_without_a_field_say_so(series):
    result = reconstruct(series, method="sirt", num_steps=2)
    assert result.field is None
    with pytest.raises(ValueError, match="sirt has no field"):
        result.sampled(2.0)


def test_memory_counts_method_and_field(series):
    from recon.methods import find_method

    grid = VolumeGrid.of(series)
    published = needed_memory(series, grid, fitted=False, more=find_method("kniesel2022-as-published").more_memory())
    assert published / 2**20 == pytest.approx(2934, rel=0.2)
    joint = find_method("joint")
    assert joint.more_memory("grids") == 0
    assert joint.more_memory("network") > 2**25
    assert joint.more_memory("auto") == joint.more_memory("network")


def test_commands_write_fields_and_finer_volumes(series, tmp_path, run):
    write_tilt_series(tmp_path / "tilts.mrc", series)
    tilts, volume, field = tmp_path / "tilts.mrc", tmp_path / "v.mrc", tmp_path / "f.safetensors"
    command = ["reconstruct", tilts, "-o", volume, "--weight", 0.3, "--steps", 4, "--mode", "transmission"]
    run(*command, "--field", "gaussians", "--voxel-size", 2, "--save-field", field)
    assert io.read(volume).data.shape == (32, 32, 32)
    told = run("export", field, "-o", tmp_path / "e.mrc", "--voxel-size", 2)
    assert told["shape"] == [32, 32, 32]
    np.testing.assert_allclose(io.read(tmp_path / "e.mrc").data, io.read(volume).data, rtol=1e-3, atol=1e-6)
    assert run("export", field, "-o", tmp_path / "e.mrc")["voxel_size"] == pytest.approx(4.0)


@pytest.mark.parametrize(("size", "words"), [(-1, "positive"), (1e6, "within the volume"), (1e-3, "larger voxels")])
def test_voxels_of_impossible_size_are_refused_before_the_fit(series, tmp_path, refused, size, words):
    write_tilt_series(tmp_path / "tilts.mrc", series)
    command = ["reconstruct", tmp_path / "tilts.mrc", "-o", tmp_path / "v.mrc", "--mode", "transmission"]
    assert words in refused(*command, "--dry-run", "--voxel-size", size)
    save_field(_of_size(4.0), tmp_path / "f.safetensors")
    assert words in refused("export", tmp_path / "f.safetensors", "-o", tmp_path / "e.mrc", "--voxel-size", size)


def _of_size(voxel_size):
    field = find_field("gaussians")((16, 16, 16), count=3)
    field.voxel_size = voxel_size
    return field
