"""Every method through one door: it gives a finite volume of about the right scale, and chooses its settings sensibly."""

import numpy as np
import pytest
import torch

from noiseflow import RadialFlow, fit
from recon.commands.reconstruct import reconstruct as reconstruct_command
from recon.methods import methods
from recon.methods.classical import best_num_iterations, best_window
from recon.methods.kniesel2022.presets import PRESETS
from recon.methods.laplace import Laplace
from recon.metrics.metrics import compare
from recon.series.tilt_series import VolumeGrid
from recon.simulate.phantoms import shells
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from tests.contracts import check_noise_model


@pytest.fixture(scope="module")
def scene():
    density = shells(24, generator=np.random.default_rng(1), count=10)
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 5.0))
    return density * unit, clean, add_noise(clean, ACQUISITIONS["skewed"].noise(), seed=2)


@pytest.mark.parametrize(
    "name", [name for name in methods.METHODS if "auto" not in name and "joint" not in name and name not in PRESETS]
)
def test_every_method_is_far_better_than_an_empty_volume(scene, name):
    truth, _, noisy = scene
    settings = {} if name in ("sirt", "wbp", "wbp-denoised") else {"num_steps": 40}
    if name not in ("explicit", "sirt", "wbp", "wbp-denoised"):
        settings["weight"] = 0.3
    outcome = methods.reconstruct(noisy, VolumeGrid.of(noisy), method=name, **settings)
    assert outcome.method == name
    assert outcome.projections.shape == noisy.images.shape
    empty = compare(np.zeros_like(truth), truth).psnr
    assert compare(outcome.volume.attenuation, truth).psnr > empty + (0.3 if "wbp" in name else 1.0)


def test_supervised_fit_keeps_the_noise_model_as_it_is(scene):
    _, clean, noisy = scene
    model = RadialFlow(4)
    fit(model, torch.from_numpy(clean.images), torch.from_numpy(noisy.images), num_steps=60)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    grid = VolumeGrid.of(noisy)
    outcome = methods.reconstruct(noisy, grid, method="joint-supervised", noise_model=model, weight=0.3, num_steps=20)
    assert all(torch.equal(value, before[name]) for name, value in outcome.noise_model.state_dict().items())
    with pytest.raises(ValueError, match="--noise-model"):
        methods.reconstruct(noisy, grid, method="joint-supervised")


def test_chosen_settings_are_nearly_the_best(scene):
    truth, _, noisy = scene
    grid = VolumeGrid.of(noisy)
    problem = methods.LineIntegralProblem.of(noisy, grid)

    def error(volume):
        return compare(volume.numpy(), truth, scaling="affine").psnr

    count = best_num_iterations(noisy, grid)
    runs = {
        n: error(methods.sirt(problem.line_integrals, problem.projector, num_iterations=n)) for n in (2, 8, 32, 128)
    }
    assert (
        error(methods.sirt(problem.line_integrals, problem.projector, num_iterations=count)) > max(runs.values()) - 0.5
    )
    window, cutoff = best_window(noisy, grid)
    chosen = methods.wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff)
    ramp = methods.wbp(problem.line_integrals, problem.projector)
    assert error(chosen) > error(ramp) + 0.5


def test_a_method_is_one_registered_function(scene, monkeypatch):
    monkeypatch.setattr(methods, "METHODS", dict(methods.METHODS))

    @methods.method("mine")
    def mine(tilt_series, grid, settings):
        return methods.Outcome(None, tilt_series.images, "mine", None, None, {"seed": settings.seed})

    assert methods.reconstruct(scene[2], VolumeGrid.of(scene[2]), method="mine", seed=7).choices == {"seed": 7}
    with pytest.raises(ValueError, match=r"choose one of auto, joint, .*mine"):
        methods.reconstruct(scene[2], VolumeGrid.of(scene[2]), method="magic")


def test_help_names_every_method():
    text = reconstruct_command.__annotations__["method"]
    assert all(name in text for name in set(methods.METHODS) - set(PRESETS))


def test_laplace_noise_keeps_the_contract_of_noise_models():
    check_noise_model(Laplace(0.3).double(), torch.tensor([-1.0, 0.0, 2.5], dtype=torch.float64))


def test_laplace_likelihood_is_least_absolute_deviations():
    generator = torch.Generator().manual_seed(0)
    observation = torch.rand(101, generator=generator, dtype=torch.float64)
    signal = torch.linspace(0, 1, 1001, dtype=torch.float64)
    nll = -Laplace(0.1).double()(signal[:, None]).log_prob(observation).sum(1)
    assert float(signal[nll.argmin()]) == pytest.approx(float(observation.median()), abs=1e-3)
