"""Every method through one door: it gives a finite volume of about the right scale, and chooses its settings sensibly."""

import numpy as np
import pytest
import torch

from noiseflow import Gaussian, RadialFlow, fit
from recon.methods import find_method, method_names, reconstruct
from recon.methods.joint import Laplace
from recon.methods.kniesel2022 import PRESETS
from recon.methods.sirt import LineIntegralProblem, best_num_iterations, best_window
from recon.metrics.metrics import compare
from recon.projection.classical import sirt, wbp
from recon.series.tilt_series import VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from tests.contracts import check_noise_model


@pytest.fixture(scope="module")
def scene():
    density = make_phantom("shells", 24, generator=np.random.default_rng(1), count=10)
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 5.0))
    return density * unit, clean, add_noise(clean, ACQUISITIONS["skewed"].noise(), seed=2)


@pytest.mark.parametrize(
    "name", [name for name in method_names() if "auto" not in name and "joint" not in name and name not in PRESETS]
)
def test_every_method_is_far_better_than_an_empty_volume(scene, name):
    truth, _, noisy = scene
    settings = {} if name in ("sirt", "wbp", "wbp-denoised") else {"num_steps": 40}
    if name not in ("explicit", "sirt", "wbp", "wbp-denoised"):
        settings["weight"] = 0.3
    outcome = reconstruct(noisy, VolumeGrid.of(noisy), method=name, **settings)
    assert outcome.method == name
    assert outcome.projections.shape == noisy.images.shape
    empty = compare(np.zeros_like(truth), truth).psnr
    assert compare(outcome.volume.attenuation, truth).psnr > empty + (0.3 if "wbp" in name else 1.0)


def test_supervised_fit_keeps_the_noise_model_as_it_is(scene):
    _, clean, noisy = scene
    model = RadialFlow(4)
    fit(model, torch.from_numpy(clean.images), torch.from_numpy(noisy.images), num_steps=5)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    grid = VolumeGrid.of(noisy)
    outcome = reconstruct(noisy, grid, method="joint-supervised", noise_model=model, weight=0.3, num_steps=5)
    assert all(torch.equal(value, before[name]) for name, value in outcome.noise_model.state_dict().items())
    with pytest.raises(ValueError, match="--noise-model"):
        reconstruct(noisy, grid, method="joint-supervised")


def test_chosen_settings_are_nearly_the_best(scene):
    truth, _, noisy = scene
    grid = VolumeGrid.of(noisy)
    problem = LineIntegralProblem.of(noisy, grid)

    def error(volume):
        return compare(volume.numpy(), truth, scaling="affine").psnr

    count = best_num_iterations(noisy, grid)
    runs = {n: error(sirt(problem.line_integrals, problem.projector, num_iterations=n)) for n in (2, 8, 32, 128)}
    assert error(sirt(problem.line_integrals, problem.projector, num_iterations=count)) > max(runs.values()) - 0.5
    window, cutoff = best_window(noisy, grid)
    chosen = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff)
    ramp = wbp(problem.line_integrals, problem.projector)
    assert error(chosen) > error(ramp) + 0.5


_MINE = """
import numpy as np
from recon.methods import Method
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import Volume

def run(tilt_series, grid, settings):
    return Reconstruction(Volume(np.zeros(grid.shape, np.float32)), tilt_series.images, "mine", choices={"seed": settings.seed})

METHOD = Method("mine", "An empty volume.", run)
"""


def test_a_method_of_another_package_is_one_file_and_one_entry_point(scene, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(_MINE)
    (tmp_path / "mine-1.0.dist-info").mkdir()
    (tmp_path / "mine-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (tmp_path / "mine-1.0.dist-info" / "entry_points.txt").write_text("[noiseflow.methods]\nmine = mine:METHOD\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert "mine" in method_names()
    assert reconstruct(scene[2], method="mine", seed=7).choices == {"seed": 7}
    with pytest.raises(ValueError, match="method mine does not support it"):
        reconstruct(scene[2], method="mine", defocus=0.1)
    find_method.cache_clear()


def test_unknown_methods_and_settings_without_use_are_refused(scene):
    with pytest.raises(ValueError, match=r"choose one of auto, explicit, joint"):
        reconstruct(scene[2], method="magic")
    with pytest.raises(ValueError, match=r"l2 does not support it"):
        reconstruct(scene[2], method="l2", noise_model=Gaussian())
    with pytest.raises(ValueError, match="at least 2"):
        reconstruct(scene[2], uncertainty=1)
    with pytest.raises(ValueError, match="needs scratch"):
        reconstruct(scene[2], method="sirt", slices_at_once=3)


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("tv", {"regulariser": "directional"}),
        ("explicit", {"weight": 1.0}),
        ("explicit", {"regulariser": "directional"}),
        ("sirt", {"weight": 1.0}),
        ("sirt", {"window": "hann"}),
        ("wbp", {"num_steps": 3}),
        ("wbp", {"uncertainty": 4}),
        ("joint", {"denoiser": "nlm"}),
    ],
)
def test_what_a_method_has_no_use_for_is_refused(scene, method, settings):
    name = next(iter(settings)).removeprefix("num_")
    with pytest.raises(
        ValueError, match=rf"--{name}: method {method} does not support it; use (?!.*\b{method}[,\n]).*"
    ):
        reconstruct(scene[2], method=method, **settings)


@pytest.mark.parametrize("name", method_names())
def test_every_method_says_what_it_is(name):
    method = find_method(name)
    assert method.name == name
    assert method.description.endswith(".")


def test_laplace_noise_keeps_the_contract_of_noise_models():
    check_noise_model(Laplace(0.3).double(), torch.tensor([-1.0, 0.0, 2.5], dtype=torch.float64))


def test_laplace_likelihood_is_least_absolute_deviations():
    generator = torch.Generator().manual_seed(0)
    observation = torch.rand(101, generator=generator, dtype=torch.float64)
    signal = torch.linspace(0, 1, 1001, dtype=torch.float64)
    nll = -Laplace(0.1).double()(signal[:, None]).log_prob(observation).sum(1)
    assert float(signal[nll.argmin()]) == pytest.approx(float(observation.median()), abs=1e-3)
