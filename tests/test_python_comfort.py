"""Python comfort: arrays and tensors alike, one-line reprs with shape and units, and a program that starts quickly."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import calibration
import noiseflow
import recon
from noiseflow import metrics
from noiseflow.fitting.selection import select
from noiseflow.installation import library_version
from noiseflow.metrics.spatial import spatial_structure
from recon.methods import find_method

RANDOM = np.random.default_rng(0)
SIGNAL = RANDOM.uniform(20, 200, (40, 48)).astype(np.float32)
NOISY = (SIGNAL + RANDOM.normal(0, 4, SIGNAL.shape)).astype(np.float32)
FRAMES = RANDOM.poisson(np.tile(SIGNAL, (5, 1, 1))).astype(np.float64)
VOLUME = RANDOM.random((6, 5, 8), dtype=np.float32)
ANGLES = np.linspace(-60, 60, 7)
FIELDS = (recon.VoxelField, recon.MultiresolutionField, recon.CoordinateNetwork, recon.GaussianField)
MODELS: list[Callable[[], torch.nn.Module]] = [
    noiseflow.Gaussian,
    noiseflow.SignalDependentGaussian,
    noiseflow.Poisson,
    noiseflow.PoissonGaussian,
    noiseflow.GaussianWithOutliers,
    noiseflow.Mixture,
    noiseflow.RadialFlow,
    noiseflow.SplineFlow,
    noiseflow.PhysicsFlow,
    lambda: noiseflow.Digitised(noiseflow.Gaussian(), 1.0, 0.0, 255.0),
    lambda: noiseflow.ScanNoise(noiseflow.Gaussian()),
    lambda: noiseflow.WithMaps(noiseflow.Gaussian(), np.full(SIGNAL.shape, 1.1)),
    noiseflow.ExcessNoise,
    noiseflow.DeadTimeCounter,
]


def projector() -> recon.SliceProjector:
    return recon.SliceProjector(tilt_angles=ANGLES, depth=6, width=8)


def both_ways(function: Callable[[Any], Any], given: np.ndarray[Any, Any]) -> list[tuple[Any, Any]]:
    """What a function makes of an array, and of the same numbers as a tensor; a pair for each of its answers."""
    found, other = function(given), function(torch.from_numpy(given))
    return list(zip(found, other, strict=True)) if isinstance(found, tuple) else [(found, other)]


@pytest.mark.parametrize(
    ("name", "make"),
    [("log_prob", make) for make in MODELS]
    + [(name, make) for name in ("cdf", "icdf", "mean", "variance", "sample") for make in (MODELS[0], MODELS[8])],
)
def test_noise_models_return_what_they_are_given(name: str, make: Callable[[], torch.nn.Module]) -> None:
    model = make()
    signal = SIGNAL / 255 if make is noiseflow.PhysicsFlow else SIGNAL

    def ask(given: Any) -> Any:
        distribution = model(given)
        if name in ("mean", "variance"):
            return getattr(distribution, name)
        if name == "sample":
            return distribution.sample(generator=torch.Generator().manual_seed(1))
        return getattr(distribution, name)(0 * given + 0.4 if name == "icdf" else given)

    ((array, tensor),) = both_ways(ask, signal)
    assert (type(array), type(tensor)) == (np.ndarray, torch.Tensor)
    assert array.shape == SIGNAL.shape
    np.testing.assert_allclose(array, tensor.detach().numpy(), rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "array"),
    [
        (lambda x: projector()(x), VOLUME),
        (lambda x: projector().T(x), RANDOM.random((7, 5, 8), dtype=np.float32)),
        (lambda x: recon.sirt(x, projector(), num_iterations=3), RANDOM.random((7, 5, 8), dtype=np.float32)),
        (lambda x: recon.wbp(x, projector()), RANDOM.random((7, 5, 8), dtype=np.float32)),
        (lambda x: recon.total_variation(x, smoothing=0.1), VOLUME),
        (lambda x: recon.fourier_shell_correlation(x, x), VOLUME),
        (lambda x: metrics.pixel_log_prob(noiseflow.Gaussian(), x, x), SIGNAL.ravel()),
    ],
    ids=["project", "back-project", "sirt", "wbp", "total_variation", "fsc", "pixel_log_prob"],
)
def test_functions_return_what_they_are_given(function: Callable[[Any], Any], array: np.ndarray[Any, Any]) -> None:
    for from_array, from_tensor in both_ways(function, array):
        assert (type(from_array), type(from_tensor)) == (np.ndarray, torch.Tensor)
        assert np.isfinite(from_array).all()
        assert np.any(from_array != 0)
        np.testing.assert_allclose(from_array, from_tensor.detach().numpy(), rtol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda s, o: noiseflow.fit(noiseflow.Gaussian(), s, o, num_steps=5).held_out_nll,
        lambda s, o: metrics.evaluate(noiseflow.Gaussian(4.0), s, o).nll,
        lambda s, o: metrics.divergence(noiseflow.Gaussian(4.0), s.reshape(-1), o.reshape(-1)).jsd,
        lambda s, o: select(s, o, candidates={"a": noiseflow.Gaussian()}, num_steps=5).chosen.nll,
        lambda s, o: spatial_structure(noiseflow.Gaussian(4.0), s, o).rows,
        lambda s, o: noiseflow.detect_digitisation(o)[:4],
        lambda s, o: recon.compare(o, s).psnr,
        lambda s, o: noiseflow.KnownSignal(s).signal().sum().item(),
        lambda s, o: noiseflow.StaticScene(o).image().sum().item(),
        lambda s, o: calibration.ExposurePair(o, s).short.sum(),
        lambda s, o: recon.TiltSeries(o[:7, None], ANGLES).images.sum(),
        lambda s, o: recon.Volume(o[None]).attenuation.sum(),
    ],
    ids=[
        "fit",
        "evaluate",
        "divergence",
        "select",
        "spatial",
        "digitisation",
        "compare",
        "known",
        "scene",
        "pair",
        "series",
        "volume",
    ],
)
def test_functions_find_the_same_in_arrays_and_tensors(function: Callable[[Any, Any], Any]) -> None:
    found = function(SIGNAL, NOISY)
    assert found == pytest.approx(function(torch.from_numpy(SIGNAL), torch.from_numpy(NOISY)), rel=1e-6)


@pytest.mark.parametrize("kind", ["u1", "i2", ">u2", "<u4", ">f4", "f2", "f8", "?"])
def test_arrays_of_every_real_type_serve(kind: str) -> None:
    array = (SIGNAL / (400 if kind == "?" else 1)).astype(kind)
    array.flags.writeable = False
    expected = noiseflow.Gaussian(4.0)(torch.from_numpy(array.astype(np.float64))).log_prob(torch.tensor(100.0))
    np.testing.assert_allclose(noiseflow.Gaussian(4.0)(array).log_prob(100.0), expected.detach().numpy(), rtol=1e-3)


def test_complex_array_is_refused_with_the_fix() -> None:
    with pytest.raises(ValueError, match=r"complex64.*\.astype"):
        noiseflow.Gaussian()(SIGNAL.astype(np.complex64))


def public_classes() -> set[type]:
    found = set()
    for package in (noiseflow, recon, calibration):
        found |= {value for value in map(package.__getattr__, package.__all__) if inspect.isclass(value)}
    return found - {noiseflow.NoiseModelBase, noiseflow.SignalModel, recon.Field}


@pytest.fixture(scope="module")
def instances() -> list[Any]:
    """One of every public class that is quickly made."""
    folder = Path(noiseflow.__file__).parent / "data" / "exposures_miro"
    (pair,) = calibration.read_pairs([folder / "channel1_050ms.tif"], [folder / "channel1_long.tif"])
    aligned = calibration.align_pair(pair)
    images = projector()(VOLUME)
    series = recon.TiltSeries(images, ANGLES, 2.5, "linear")
    grid = recon.VolumeGrid.of(series, 6)
    reconstructor = recon.JointReconstructor(weight=0.4, noise_model=noiseflow.Gaussian, num_steps=4)
    result = reconstructor(series, grid)
    return [
        *(make() for make in MODELS),
        noiseflow.AtLevel(noiseflow.Gaussian(0.1), 1000.0),
        noiseflow.StuckPixels(noiseflow.Poisson(), level=0.0, share=0.1),
        noiseflow.Correlated(noiseflow.Gaussian(0.1), torch.ones(1, 3)),
        noiseflow.Edged(noiseflow.Gaussian(0.1)),
        noiseflow.Wrapped(noiseflow.Gaussian(0.1)),
        noiseflow.Conditioned(noiseflow.Gaussian(0.1), {"gain": [1.0, 2.0]}),
        noiseflow.Digitisation(1.0, 0, 255),
        noiseflow.KnownSignal(SIGNAL),
        noiseflow.StaticScene(NOISY),
        *(pair, aligned, aligned.registration, calibration.Burst(FRAMES)),
        *(series, grid, reconstructor, result, result.volume, result.fit_result, result.signal_model, projector()),
        *(kind((6, 5, 8)) for kind in FIELDS),
        recon.DualAxisProjector(
            tilt_angles=ANGLES, axes=[0.0] * (len(ANGLES) - 1) + [90.0], depth=6, height=5, width=8
        ),
        recon.Alignment(3.0, np.zeros((len(ANGLES), 2)), np.asarray(ANGLES)),
        *(recon.Linear(), recon.Transmission(torch.ones(7))),
        *(recon.prepare(series), find_method("sirt")),
    ]


@pytest.fixture(scope="module")
def measured() -> list[Any]:
    """One of every public class that it takes a calibration to make."""
    scene = np.tile(np.linspace(20, 400, 64), (5, 64, 1))
    frames = np.random.default_rng(0).poisson(scene).astype(np.float64)
    pairs, burst_report = calibration.align_burst(calibration.Burst(frames))
    pixels = calibration.collect_pixels(pairs)
    scores = calibration.fit_models(pixels, kinds=("gaussian",))
    detector = calibration.measure_detector(pairs)
    findings = calibration.Findings(pairs, pixels, scores, detector)
    return [burst_report, scores[0], detector, detector.posterior, detector.line, findings]


def test_objects_say_what_they_are_in_one_line(instances: list[Any]) -> None:
    check_lines(instances)


@pytest.mark.slow
def test_every_public_object_says_what_it_is_in_one_line(instances: list[Any], measured: list[Any]) -> None:
    missing = public_classes() - {type(each) for each in [*instances, *measured]}
    assert not missing, missing
    check_lines(measured)
    for kind, word in (("PhotonTransfer", "counts per electron"), ("DetectorPosterior", "read noise (electrons)")):
        assert word in next(repr(each) for each in measured if type(each).__name__ == kind)


def check_lines(objects: list[Any]) -> None:
    for each in objects:
        text = repr(each)
        assert text.startswith(f"{type(each).__name__}("), text
        assert "\n" not in text
        assert " at 0x" not in text
        assert "array(" not in text
        assert len(text) < 1500, text


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("Gaussian", ["scale=0.1", "detector units"]),
        ("SplineFlow", ["width=32", "parameters", "detector units"]),
        ("WithMaps", ["40 x 48 pixels", "Gaussian(scale=0.1)"]),
        ("ExposurePair", ["400 x 400 float64 detector units"]),
        ("Registration", ["px"]),
        ("TiltSeries", ["7 x 5 x 8 float32", "-60° to 60°", "2.5 Å per pixel", "linear"]),
        ("Volume", ["6 x 5 x 8 float32", "2.5 Å per voxel"]),
        ("VolumeGrid", ["depth=6 voxels", "2.5 Å"]),
        ("SliceProjector", ["7 tilts -60° to 60°", "6 x 8 voxels"]),
        ("MultiresolutionField", ["6 x 5 x 8 voxels (z, y, x)", "per voxel"]),
        ("Prepared", ["7 x 5 x 8 float32", "Screening("]),
        ("Method", ["name='sirt'"]),
        ("Transmission", ["(7 tilts)", "detector units"]),
        ("FitResult", ["nats per pixel", " s,"]),
        ("JointReconstructor", ["weight=0.4", "num_steps=4"]),
        ("Reconstruction", ["6 x 5 x 8 float32", "Gaussian(", "nats per pixel"]),
    ],
)
def test_reprs_tell_shape_units_and_settings(instances: list[Any], kind: str, words: list[str]) -> None:
    text = repr(next(each for each in instances if type(each).__name__ == kind))
    assert all(word in text for word in words), text


def test_units_of_a_model_survive_its_file(tmp_path: Path) -> None:
    noiseflow.save(noiseflow.Gaussian(2.0), tmp_path / "first.safetensors", units="counts")
    model = noiseflow.load(tmp_path / "first.safetensors")
    assert "units='counts'" in repr(model)
    noiseflow.save(model, tmp_path / "second.safetensors")
    assert "units='counts'" in repr(noiseflow.load(tmp_path / "second.safetensors"))


def program(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "noiseflow", *words]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)


def test_version_is_the_packages() -> None:

    done = program("--version")
    assert (done.returncode, done.stdout.split()) == (0, ["noiseflow", library_version()])


@pytest.mark.parametrize(
    ("shell", "words"),
    [
        ("bash", {"COMP_WORDS": "noiseflow reconstruct --me", "COMP_CWORD": "2"}),
        ("zsh", {"_TYPER_COMPLETE_ARGS": "noiseflow reconstruct --me"}),
    ],
)
def test_shells_can_complete_commands_and_options(shell: str, words: dict[str, str]) -> None:
    script = program("--show-completion", shell, _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert "_NOISEFLOW_COMPLETE" in script.stdout, script.stderr
    assert "--method" in program(_NOISEFLOW_COMPLETE=f"complete_{shell}", **words).stdout


def test_package_modules_are_found_lazily() -> None:
    code = "import sys, noiseflow, recon, calibration; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False", done.stdout + done.stderr


def test_version_is_told_by_the_package_as_by_the_program(capsys: pytest.CaptureFixture[str]) -> None:
    from noiseflow.commands.cli import main

    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out.split() == ["noiseflow", noiseflow.__version__]
