"""Noise-model files: the same model comes back, and nothing else is let in."""

import inspect
import json
import os
import resource
import signal
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import noiseflow
from noiseflow.io.model_files import FORMAT_VERSION, kinds

SIGNAL = torch.linspace(0, 1, 7)[None]
WRAPPERS = {
    "AtLevel": lambda: noiseflow.AtLevel(noiseflow.SplineFlow(), 100.0),
    "Correlated": lambda: noiseflow.Correlated(noiseflow.RadialFlow(3), torch.ones(1, 3)),
    "Digitised": lambda: noiseflow.Digitised(noiseflow.RadialFlow(3), low=0.0, high=255.0),
    "ScanNoise": lambda: noiseflow.ScanNoise(noiseflow.SplineFlow(), 0.3),
    "Edged": lambda: noiseflow.Edged(noiseflow.SplineFlow()),
    "Wrapped": lambda: noiseflow.Wrapped(noiseflow.SplineFlow(), 0.0, 180.0),
    "StuckPixels": lambda: noiseflow.StuckPixels(noiseflow.Poisson(), level=0.0, share=0.1),
    "WithMaps": lambda: noiseflow.WithMaps(noiseflow.Gaussian(), torch.full((1, 7), 1.5)),
}


def make(kind: str) -> torch.nn.Module:
    model = WRAPPERS[kind]() if kind in WRAPPERS else kinds()[kind]()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return model


@pytest.mark.parametrize(
    "kind", sorted({*kinds()} - {"Conditioned"})
)  # which needs a condition, and has tests of its own
def test_same_model_comes_back(tmp_path: Path, kind: str) -> None:
    model = make(kind)
    path = noiseflow.save(model, tmp_path / "model.safetensors", units="counts", provenance={"from": "a test"})
    again = noiseflow.load(path)
    assert type(again) is type(model)
    observation = torch.linspace(-0.2, 1.5, 7)[None]
    assert torch.equal(again(SIGNAL).log_prob(observation), model(SIGNAL).log_prob(observation))
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    assert json.loads(metadata["model"])["kind"] == kind
    assert metadata["units"] == "counts"
    assert json.loads(metadata["provenance"]) == {"from": "a test"}


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_a_model_comes_back_in_its_precision(tmp_path: Path, dtype: torch.dtype) -> None:
    model = make("SplineFlow").to(dtype)
    again = noiseflow.load(noiseflow.save(model, tmp_path / "model.safetensors"))
    assert {each.dtype for each in again.parameters()} == {dtype}
    assert all(each.requires_grad for each in again.parameters())
    assert torch.equal(again(SIGNAL).log_prob(SIGNAL), model(SIGNAL).log_prob(SIGNAL))


def rewrite(path: Path, **changes: str | None) -> Path:
    """The file of a default Gaussian with some metadata changed or removed."""
    noiseflow.save(noiseflow.Gaussian(), path)
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        metadata = {**file.metadata(), **changes}
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors, path, metadata={key: value for key, value in metadata.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "something else"}, "not a noiseflow noise model"),
        ({"format_version": "99"}, "update noiseflow"),
        ({"model": json.dumps({"kind": "os.system", "arguments": {}})}, "unknown noise model"),
        ({"model": json.dumps({"kind": "Gaussian", "arguments": {"scale": "x"}})}, "scale is 'x'"),
        ({"model": json.dumps({"kind": "RadialFlow", "arguments": {}})}, "do not fit a RadialFlow"),
        ({"model": "{"}, "damaged"),
        ({"model": None}, "damaged"),
    ],
)
def test_foreign_future_and_damaged_files_are_refused(tmp_path: Path, changes: dict, message: str) -> None:
    path = rewrite(tmp_path / "model.safetensors", **changes)
    with pytest.raises(ValueError, match=message):
        noiseflow.load(path)


def test_non_finite_parameters_are_refused(tmp_path: Path) -> None:
    model = noiseflow.Gaussian()
    model.log_scale.data.fill_(float("nan"))
    path = noiseflow.save(model, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="NaN or infinite"):
        noiseflow.load(path)


def test_truncated_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = noiseflow.save(noiseflow.Gaussian(), tmp_path / "model.safetensors")
    whole = path.read_bytes()
    for size in (0, 4, 8, 50, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged"):
            noiseflow.load(path)
    with pytest.raises(FileNotFoundError, match="noiseflow calibrate"):
        noiseflow.load(tmp_path / "none.safetensors")


def test_unknown_models_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no known noise model"):
        noiseflow.save(torch.nn.Linear(1, 1), tmp_path / "model.safetensors")
    assert not list(tmp_path.iterdir())


def test_registered_model_is_saved_and_loaded_inside_others_too(tmp_path: Path) -> None:
    @noiseflow.register
    class Doubled(noiseflow.NoiseModelBase):
        """Gaussian noise of a width given by its doubled logarithm."""

        def __init__(self, offset: float = 0.0) -> None:
            super().__init__()
            self.offset, self.half_log = offset, torch.nn.Parameter(torch.tensor(-1.0))

        def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:
            return noiseflow.Gaussian(float(torch.exp(2 * self.half_log)))(signal + self.offset)

        def config(self) -> dict[str, float]:
            return {"offset": self.offset}

    model = noiseflow.Digitised(Doubled(0.25), 0.1)
    with torch.no_grad():
        model.model.half_log.fill_(-0.5)
    again = noiseflow.load(noiseflow.save(model, tmp_path / "model.safetensors"))
    assert type(again.model) is Doubled
    assert torch.equal(again(SIGNAL).log_prob(SIGNAL), model(SIGNAL).log_prob(SIGNAL))


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        (torch.nn.Linear, TypeError, "NoiseModelBase"),
        (noiseflow.NoiseModelBase, TypeError, "forward"),
        (type("Gaussian", (noiseflow.Poisson,), {}), ValueError, "has the name"),
    ],
)
def test_only_noise_models_of_a_free_name_are_registered(kind: type, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        noiseflow.register(kind)


def is_refused_within(mebibytes: int, path: Path) -> bool:
    """Whether a process of its own refuses the file in less than a minute and this much more memory."""
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            noiseflow.load(path)
        except ValueError:
            small = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < mebibytes * 1024  # KiB
            os._exit(0 if small else 1)
        finally:
            os._exit(2)
    return os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("kind", sorted(kinds()))
def test_no_size_that_a_file_claims_costs_memory(kind: str, tmp_path: Path) -> None:
    """Every whole number as large as any may be without parameters for it, and every list long: refused, or small."""
    noiseflow.load(noiseflow.save(noiseflow.SplineFlow(), tmp_path / "usual.safetensors"))  # imports what loading needs
    defaults = {name: each.default for name, each in inspect.signature(kinds()[kind].__init__).parameters.items()}
    claims = {name: 1024 for name, value in defaults.items() if type(value) is int}
    claims |= {"shape": [1024, 1024]} if "shape" in defaults else {}
    claims |= {name: [1024] * 1024 for name, value in defaults.items() if isinstance(value, (list, tuple))}
    metadata = {"format": "noiseflow noise model", "format_version": str(FORMAT_VERSION), "units": "counts"}
    inner = {"model": {"kind": "Gaussian", "arguments": {}}} if "model" in defaults else {}
    metadata["model"] = json.dumps({"kind": kind, "arguments": claims, "models": inner})
    save_file({"a": torch.zeros(1)}, tmp_path / "claims.safetensors", metadata)
    assert is_refused_within(100, tmp_path / "claims.safetensors")


@pytest.mark.parametrize("count", [1_000_000, 4_000_000])
@pytest.mark.parametrize("kind", sorted(kinds()))
def test_no_size_that_the_parameters_allow_costs_much_more_than_the_file(kind: str, count: int, tmp_path: Path) -> None:
    """A file of 4 MB whose every size is as large as its parameters could be, or as their number."""
    with torch.device("meta"):
        noiseflow.Mixture()  # imports what it needs
    arguments = inspect.signature(kinds()[kind].__init__).parameters
    sizes = {name: count for name, each in arguments.items() if type(each.default) is int and name != "neighbourhood"}
    inner = {"model": {"kind": "Gaussian", "arguments": {}}} if "model" in arguments else {}
    metadata = {"format": "noiseflow noise model", "format_version": str(FORMAT_VERSION), "units": "counts"}
    for name, size in sizes.items():
        metadata["model"] = json.dumps({"kind": kind, "arguments": {name: size}, "models": inner})
        save_file({"a": torch.zeros(4_000_000, dtype=torch.int8)}, tmp_path / "claims.safetensors", metadata)
        assert is_refused_within(160, tmp_path / "claims.safetensors"), name
