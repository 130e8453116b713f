"""The contract of noise models: abstract for real, every trait declared, and none looked up by name elsewhere."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

import noiseflow
from noiseflow.io.model_files import kinds
from noiseflow.models.wrapper import ForeignModel, ModelAround, as_noise_model
from recon.methods.kniesel2022 import PaperFlow
from recon.simulate.noises import SkewedNoise
from tests.contracts import check_traits

ROOT = Path(noiseflow.__file__).parent
SIGNALS = torch.linspace(0.2, 0.8, 30).reshape(5, 6)
OBSERVATION = SIGNALS + 0.1 * torch.sin(torch.arange(30.0)).reshape(5, 6)
MODELS = {
    **{name: kind for name, kind in kinds().items() if not issubclass(kind, ModelAround)},
    "neighbourhood": lambda: noiseflow.SplineFlow(neighbourhood=3),
    "clipped flow": lambda: noiseflow.Digitised(noiseflow.PhysicsFlow(), 0.0, 0.0, 1.0),
    "rounded": lambda: noiseflow.Digitised(noiseflow.Gaussian(), 0.1),
    "rows": lambda: noiseflow.ScanNoise(noiseflow.Digitised(noiseflow.Gaussian(), 0.1)),
    "columns": lambda: noiseflow.ScanNoise(noiseflow.Gaussian(), along="column"),
    "maps": lambda: noiseflow.WithMaps(noiseflow.Gaussian(), torch.ones(5, 6)),
    "rounded maps": lambda: noiseflow.Digitised(noiseflow.WithMaps(noiseflow.Gaussian(), torch.ones(5, 6)), 0.1),
    "conditioned": lambda: noiseflow.Conditioned(noiseflow.Mixture(), {"gain": [1.0, 2.0]}).at({"gain": 1.5}),
    "at a level": lambda: noiseflow.AtLevel(noiseflow.SignalDependentGaussian(), 0.3),
    "correlated": lambda: noiseflow.Correlated(noiseflow.Gaussian(), torch.ones(3, 3)),
    "stuck pixels": lambda: noiseflow.StuckPixels(noiseflow.Digitised(noiseflow.Gaussian(), 0.1), 0.2, 0.1),
    "edged": lambda: noiseflow.Edged(noiseflow.RadialFlow(2)),
    "wrapped": lambda: noiseflow.Wrapped(noiseflow.RadialFlow(2), 0.0, 1.0),
    "published flow": PaperFlow,
    "skewed": SkewedNoise,
}


@pytest.mark.parametrize("name", MODELS)
def test_traits_keep_their_contract(name: str) -> None:
    check_traits(MODELS[name](), SIGNALS, OBSERVATION)


def test_base_is_abstract() -> None:
    class Nothing(noiseflow.NoiseModelBase):
        """Has no forward."""

    with pytest.raises(TypeError, match="forward"):
        Nothing()


def test_models_around_others_share_their_traits() -> None:
    class Own(noiseflow.Gaussian):
        learning_rate, num_steps, joint_learning_rate, most_joint_steps = 0.2, 7, 0.3, 5
        starts_most_likely = starts_anew = True

    own = Own()
    around = noiseflow.ScanNoise(noiseflow.Digitised(own, 1.0))
    names = (
        "learning_rate",
        "num_steps",
        "joint_learning_rate",
        "most_joint_steps",
        "starts_most_likely",
        "starts_anew",
    )
    assert all(getattr(around, name) == getattr(own, name) for name in names)
    around.tabulate = False
    assert own.tabulate is False
    assert around.describes_single_readings
    assert around.one_pixel is own
    assert around.shared_axis == -1


def test_converter_is_put_inside_offsets_of_rows() -> None:
    rows = noiseflow.ScanNoise(noiseflow.Gaussian())
    assert rows.behind(lambda inner: noiseflow.Digitised(inner, 1.0)) is rows
    assert isinstance(rows.model, noiseflow.Digitised)
    with pytest.raises(ValueError, match=r"ScanNoise\(Digitised"):
        noiseflow.Digitised(noiseflow.ScanNoise(noiseflow.Gaussian()), 1.0)


class Plain(nn.Module):
    """A module of another library: no trait at all."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(0.0))

    def forward(self, signal: Tensor) -> torch.distributions.Distribution:
        return torch.distributions.Normal(signal, self.log_scale.exp())


def test_plain_module_is_fitted_as_it_is() -> None:
    model = Plain()
    signal = torch.rand(4000, generator=torch.Generator().manual_seed(0))
    observation = signal + 0.5 * torch.randn(4000, generator=torch.Generator().manual_seed(1))
    result = noiseflow.fit(model, signal, observation, learning_rate=0.05, num_steps=200)
    assert result.noise_model is model
    assert float(model.log_scale.detach().exp()) == pytest.approx(0.5, rel=0.05)
    assert isinstance(as_noise_model(model), ForeignModel)
    with pytest.raises(TypeError, match="NoiseModelBase"):
        as_noise_model("Gaussian")


def test_no_trait_is_looked_up_by_name() -> None:
    """A trait that is looked up by ``getattr`` or ``hasattr`` is one that the base does not declare."""
    traits = {name for name in vars(noiseflow.NoiseModelBase) if not name.startswith("_")}
    for folder in ("models", "fitting", "interop", "commands", "io"):
        for file in (ROOT / folder).glob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                named = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) > 1
                if named and node.func.id in ("getattr", "hasattr") and isinstance(node.args[1], ast.Constant):
                    owner = ast.unparse(node.args[0])
                    assert node.args[1].value not in traits or owner == "self.module", f"{file}: {ast.unparse(node)}"


@pytest.mark.parametrize("kind", [torch.float16, torch.int64])
def test_maps_keep_their_values_whatever_the_number_type_of_the_signal(kind: torch.dtype) -> None:
    model = noiseflow.WithMaps(noiseflow.PoissonGaussian(), torch.full((5, 6), 0.98), variance=torch.full((5, 6), 7e4))
    signal, observation = torch.full((5, 6), 40), torch.full((5, 6), 50.0)
    with torch.no_grad():
        found = model(signal.to(kind)).log_prob(observation)
        expected = model(signal.float()).log_prob(observation)
    torch.testing.assert_close(found.float(), expected.float(), rtol=1e-3, atol=1e-3)


class _Operators(TorchDispatchMode):
    """Counts the operators that torch runs."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(("model", "most"), [(noiseflow.RadialFlow, 300), (noiseflow.SignalDependentGaussian, 150)])
def test_likelihoods_of_few_pixels_take_few_operators(model: Any, most: int) -> None:
    """Fits evaluate some thousand cells, where the number of operators costs more than that of the cells."""
    signal, noise = torch.linspace(0.2, 1.0, 500), model()
    with _Operators() as ran:
        noise(signal).log_prob(signal)
    assert ran.count < most
