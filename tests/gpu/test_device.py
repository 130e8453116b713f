"""Everything computes on a GPU as on the CPU: models, fits, projectors, fields, methods and commands.

Without a GPU, a pretended one finds what was left on the wrong device.
"""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

import noiseflow
import recon
from noiseflow import io, metrics
from recon.fields.regularisers import DirectionalVariation, SecondOrderVariation, TotalVariation
from recon.metrics.metrics import compare
from recon.projection.defocused_projector import DefocusedProjector, ImageDefocusedProjector
from recon.projection.tiles import Tiles
from recon.simulate.noises import SkewedNoise
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from tests.commands import run_command
from tests.contracts import check_sampler
from tests.gpu.pretended import pretended_gpu
from tests.noiseflow.distributions.test_contract import MODELS
from tests.recon.test_contracts import FIELDS

DEVICE = torch.device("cuda", 0)


@pytest.fixture(autouse=True)
def a_gpu() -> Iterator[None]:
    with nullcontext() if torch.cuda.is_available() else pretended_gpu():
        yield


MORE = {
    "excess noise": lambda: noiseflow.ExcessNoise(0.05, -0.02, 0.9),
    "dead time": lambda: noiseflow.DeadTimeCounter(0.02),
    "spline with neighbours": lambda: noiseflow.SplineFlow(neighbourhood=3),
    "scan noise": lambda: noiseflow.ScanNoise(noiseflow.Gaussian(0.1), 0.1),
    "correlated": lambda: noiseflow.Correlated(noiseflow.Gaussian(0.1), np.ones((3, 3)) / 3),
}
EVERY = MODELS | {name: MORE[name] for name in ("excess noise", "dead time")}
_SIGNALS = torch.linspace(0.05, 0.97, 60)


def on(device, model, signal, observation):
    """Log-likelihood, its gradient, distribution function, quantiles and moments."""
    model, signal = model.to(device), signal.to(device).requires_grad_()
    distribution = model(signal)
    log_prob = distribution.log_prob(observation.to(device))
    (slope,) = torch.autograd.grad(log_prob.sum(), signal)
    with torch.no_grad():
        found = {
            "log_prob": log_prob,
            "gradient": slope,
            "cdf": distribution.cdf(observation.to(device)),
            "mean": distribution.mean,
            "variance": distribution.variance,
        }
    assert {each.device.type for each in found.values()} == {torch.device(device).type}
    return {name: each.detach().cpu() for name, each in found.items()}


def test_a_converter_is_where_its_model_is():
    model = noiseflow.Digitised(noiseflow.PoissonGaussian().to(DEVICE), levels=[0.0, 1.0, 4.0])
    assert {each.device.type for each in (*model.parameters(), *model.buffers())} == {DEVICE.type}


_LONG = ("physics and flow", "clipped detector", "8-bit physics")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in _LONG else []) for name in EVERY]
)
def test_a_noise_model_gives_the_same_on_both_devices(name):
    model = EVERY[name]().double()
    signal = _SIGNALS.double()
    with torch.no_grad():
        observation = model(signal).sample(generator=torch.Generator().manual_seed(0))
    one, other = (on(device, model, signal, observation) for device in ("cpu", DEVICE))
    for what, value in one.items():
        torch.testing.assert_close(
            other[what], value, rtol=1e-8, atol=1e-8, msg=lambda text, what=what: f"{what}: {text}"
        )


@pytest.mark.slow
@pytest.mark.skipif(not torch.cuda.is_available(), reason="a pretended GPU draws as the CPU does")
@pytest.mark.parametrize("name", EVERY)
def test_draws_made_on_the_device_follow_the_model(name):
    model, signals = EVERY[name]().to(DEVICE).double(), torch.tensor([0.1, 0.6], dtype=torch.float64, device=DEVICE)
    generator = torch.Generator(DEVICE).manual_seed(0)
    with torch.no_grad():
        draws = model(signals).sample((20_000,), generator=generator)
        assert draws.device.type == DEVICE.type
        check_sampler(model, signals, draws)


@pytest.mark.parametrize("name", MORE)
def test_models_of_images_evaluate_and_sample(name):
    model = MORE[name]().to(DEVICE)
    signal = torch.rand(24, 24, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    drawn = model(signal).sample(generator=torch.Generator(DEVICE).manual_seed(0))
    assert drawn.device.type == DEVICE.type
    assert bool(torch.isfinite(model(signal).log_prob(drawn)).all())


def pixels(count=20_000):
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(count, generator=generator)
    return signal, signal + (0.02 + 0.05 * signal) * torch.randn(count, generator=generator)


@pytest.mark.slow
@pytest.mark.parametrize("make", [noiseflow.Mixture, noiseflow.SplineFlow, noiseflow.RadialFlow, noiseflow.PhysicsFlow])
def test_a_fit_reaches_the_likelihood_of_the_fit_on_the_cpu(make):
    signal, observation = pixels()
    found = []
    for device in ("cpu", DEVICE):
        model = make().to(device)
        noiseflow.fit(model, signal.to(device), observation.to(device), num_steps=150)
        assert model.device.type == torch.device(device).type
        with torch.no_grad():
            found.append(float(model(signal.to(device)).log_prob(observation.to(device)).mean()))
    assert found[1] == pytest.approx(found[0], abs=0.01)


def test_a_joint_fit_with_known_noise_that_has_no_tensors():
    frames = torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    scene = noiseflow.StaticScene(frames)
    assert np.isfinite(noiseflow.fit(SkewedNoise(), scene, frames, num_steps=8).held_out_nll)


def test_pixels_elsewhere_than_the_model_are_refused():
    signal, observation = (each.to(DEVICE) for each in pixels(100))
    with pytest.raises(ValueError, match="cpu and cuda"):
        noiseflow.fit(noiseflow.Mixture(), signal, observation)


@pytest.mark.slow
def test_selection_evaluation_and_files(tmp_path):
    signal, observation = (each.to(DEVICE) for each in pixels(8000))
    model = noiseflow.select(signal, observation).chosen.model
    assert next(model.parameters()).device.type == DEVICE.type
    evaluation = metrics.evaluate(model, signal, observation)
    assert evaluation.overall.jsd < 0.02
    noiseflow.save(model, tmp_path / "model.safetensors")
    assert noiseflow.load(tmp_path / "model.safetensors").device.type == "cpu"


def in_focus(dtype=torch.float64, device=DEVICE):
    return recon.SliceProjector(
        tilt_angles=[-71.0, -20.0, 0.0, 33.0, 90.0], depth=6, width=9, detector_width=11, dtype=dtype, device=device
    )


def two_axes(second, device):
    return recon.DualAxisProjector(
        tilt_angles=[-40.0, 0.0, 40.0, -40.0, 40.0],
        axes=[0.0, 0.0, 0.0, second, second],
        depth=6,
        height=9,
        width=9,
        dtype=torch.float64,
        device=device,
    )


PROJECTORS = {
    "slices": lambda device: in_focus(device=device),
    "defocused": lambda device: DefocusedProjector(in_focus(device=device), 0.2),
    "defocused in the image": lambda device: ImageDefocusedProjector(in_focus(device=device), 0.2),
    "two axes": lambda device: two_axes(90.0, device),
    "two axes, not square": lambda device: two_axes(88.0, device),
}


@pytest.mark.parametrize("name", PROJECTORS)
def test_a_projector_and_its_adjoint(name):
    A, same = PROJECTORS[name](DEVICE), PROJECTORS[name]("cpu")
    generator = torch.Generator().manual_seed(0)
    height = A.fixed_height or 4
    volume = torch.rand(A.depth, height, A.width, generator=generator, dtype=A.dtype)
    images = same(volume)
    noise = torch.rand(images.shape, generator=generator, dtype=A.dtype)
    torch.testing.assert_close(A(volume.to(DEVICE)).cpu(), images)
    torch.testing.assert_close(A.T(noise.to(DEVICE)).cpu(), same.T(noise))
    one, other = (A(volume.to(DEVICE)) * noise.to(DEVICE)).sum(), (volume.to(DEVICE) * A.T(noise.to(DEVICE))).sum()
    assert float(one) == pytest.approx(float(other), rel=1e-10)
    if A.has_parts:
        columns = torch.tensor([3, 17, 40], device=DEVICE)
        some = torch.zeros(A.depth * A.width, 4, dtype=A.dtype, device=DEVICE)
        some[columns] = torch.rand(3, 4, generator=generator, dtype=A.dtype).to(DEVICE)
        matrix, transposed = A.part(columns)
        torch.testing.assert_close(matrix @ some[columns], A.project(some))
        rays = torch.rand(A.num_tilts * A.detector_width, 4, generator=generator, dtype=A.dtype).to(DEVICE)
        torch.testing.assert_close(transposed @ rays, A.backproject(rays)[columns])


@pytest.mark.parametrize("name", FIELDS)
def test_a_field_on_tiles(name):
    torch.manual_seed(0)
    field = FIELDS[name]((6, 8, 10), scale=0.3)
    rough = torch.zeros(3, 4, 5)
    rough[1:, 1:3, 2:4] = 0.3
    field.start_from(rough)
    here = field.units().detach().clone()
    there = field.to(DEVICE).units()
    torch.testing.assert_close(there.detach().cpu(), here, rtol=1e-3, atol=1e-4)
    projector = recon.SliceProjector(tilt_angles=[-40.0, 0.0, 40.0], depth=6, width=10, device=DEVICE)
    mask = torch.zeros(6, 10, 8, dtype=torch.bool, device=DEVICE)
    mask[2:5, 3:8, 1:7] = True
    tiles = Tiles(mask, projector)
    values = field.on(tiles)
    torch.testing.assert_close(tiles.spread(values), field.units() * tiles.mask)
    tiles.project(values).square().sum().backward()
    assert all(p.grad is not None and bool(torch.isfinite(p.grad).all()) for p in field.parameters())


@pytest.mark.parametrize("make", [TotalVariation, DirectionalVariation, SecondOrderVariation])
def test_a_regulariser(make):
    volume = torch.rand(6, 8, 10, generator=torch.Generator().manual_seed(0))
    found = []
    for device in ("cpu", DEVICE):
        at = volume.clone().to(device).requires_grad_()
        value = make()(at, torch.tensor(0.3, device=device))
        (slope,) = torch.autograd.grad(value, at)
        found.append((float(value.detach()), slope.cpu()))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-4)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-3, atol=1e-5)


@pytest.fixture(scope="module")
def scene():
    density = make_phantom("shells", 24, generator=np.random.default_rng(1), count=10)
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 4.0))
    return density * unit, add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)


# after 6 steps, images that are brighter by 4e-6 change the score by 0.55 dB, after 30 by 0.03
_SHORT = {"num_steps": 30, "weight": 0.3}
METHODS = {
    "joint": _SHORT,
    "joint, error bars": _SHORT | {"uncertainty": 2},
    "joint, defocus": _SHORT | {"defocus": 0.1},
    "joint, blur": _SHORT | {"detector_blur": 0.7},
    "joint, network": _SHORT | {"field": "network"},
    "joint, gaussians": _SHORT | {"field": "gaussians"},
    "l2": _SHORT,
    "l1": _SHORT,
    "tv": _SHORT,
    "sirt": {},
    "wbp": {},
    "wbp-denoised": {},
    "kniesel2022": {"num_steps": 3},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_a_method_finds_the_volume_that_it_finds_on_the_cpu(scene, name):
    truth, noisy = scene
    method, scores = name.split(",")[0], []
    for device in ("cpu", DEVICE):
        outcome = recon.reconstruct(noisy, method=method, device=device, **METHODS[name])
        assert outcome.projections.shape == noisy.images.shape
        scores.append(compare(outcome.volume.attenuation, truth).psnr)
    assert scores[1] == pytest.approx(scores[0], abs=0.3)


@pytest.mark.slow
def test_a_field_is_chosen_on_the_device(scene):
    outcome = recon.reconstruct(scene[1], num_steps=4, field="auto", device=DEVICE)
    assert np.isfinite(outcome.volume.attenuation).all()


@pytest.mark.slow
def test_alignment_and_screening():
    density = make_phantom("shells", 32, generator=np.random.default_rng(1), count=10)
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 4.0))
    noisy = add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)
    moved = noisy.images.copy()
    moved[4] = np.roll(moved[4], 2, axis=-1)
    series = recon.TiltSeries(moved, noisy.tilt_angles, mode=noisy.mode)
    options = {"tilt_axis": 0.0, "refine_alignment": True}
    one, other = (recon.prepare(series, device=device, **options).alignment for device in ("cpu", DEVICE))
    np.testing.assert_allclose(other.shifts, one.shifts, atol=0.1)


@pytest.mark.slow
def test_two_axes(scene):
    truth, noisy = scene
    turned = np.rot90(truth, axes=(1, 2))
    clean, _ = clean_tilt_series(np.ascontiguousarray(turned) / truth.max(), noisy.tilt_angles)
    second = add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=3)
    found = [recon.prepare(noisy, second_axis=second, device=device) for device in ("cpu", DEVICE)]
    np.testing.assert_allclose(found[0].registration.explained, found[1].registration.explained, atol=0.02)
    outcome = recon.reconstruct(found[1].tilt_series, num_steps=4, weight=0.3, device=DEVICE)
    assert np.isfinite(outcome.volume.attenuation).all()


@pytest.mark.slow
def test_a_noise_model_on_the_device_serves_a_denoiser(scene):
    noisy = scene[1]
    signal = torch.rand(5000, generator=torch.Generator().manual_seed(0))
    model = noiseflow.SignalDependentGaussian()
    noiseflow.fit(model, signal, signal + 0.05 * torch.randn(5000, generator=torch.Generator().manual_seed(1)))
    volumes = [
        recon.reconstruct(noisy, method="wbp-denoised", noise_model=model.to(device), device=device).volume.attenuation
        for device in ("cpu", DEVICE)
    ]
    np.testing.assert_allclose(volumes[1], volumes[0], atol=1e-3)


def files(folder: Path, scene) -> Path:
    io.write(folder / "tilts.mrc", scene[1].images, voxel_size=(1.0, 1.0, 1.0))
    (folder / "tilts.rawtlt").write_text("\n".join(map(str, scene[1].tilt_angles)))
    return folder / "tilts.mrc"


@pytest.mark.slow
def test_commands(scene, tmp_path):
    where = ["--device", "cuda"]
    series, volume = files(tmp_path, scene), tmp_path / "volume.mrc"
    short = ["--steps", "6", "--weight", "0.3"]
    run_command(
        "reconstruct", series, "-o", volume, "--report", tmp_path / "page.html", "--uncertainty", "2", *short, *where
    )
    assert any((tmp_path / "page.html").iterdir())
    run_command("reconstruct", series, "-o", tmp_path / "low.mrc", "--slices-at-once", "8", "--steps", "20", *where)
    run_command("reconstruct", series, "-o", tmp_path / "dry.mrc", "--dry-run", *where)
    exposures = tmp_path / "short.tif", tmp_path / "long.tif"
    signal = torch.rand(192, 192, generator=torch.Generator().manual_seed(0)) * 200
    random = np.random.default_rng(0)
    smooth = torch.nn.functional.avg_pool2d(signal[None, None], 9, 1, 4)[0, 0].numpy()
    for path, dose in zip(exposures, (1, 20), strict=True):
        io.write(path, np.round(20 + 2 * random.poisson(smooth * dose)).astype(np.uint16))
    model = tmp_path / "detector.safetensors"
    run_command("calibrate", *exposures, "-o", model, "--exposure-ratio", "20", *where)
    run_command("sample", model, exposures[1], "-o", tmp_path / "noisy.tif", *where)
    run_command("evaluate", model, "--signal", exposures[1], "--observation", tmp_path / "noisy.tif", *where)
