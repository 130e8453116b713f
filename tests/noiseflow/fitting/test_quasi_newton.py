"""L-BFGS with one gradient per step."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

import noiseflow
from noiseflow.fitting.quasi_newton import QuasiNewton
from noiseflow.fitting.signal_models import KnownSignal
from noiseflow.fitting.steps import quasi_newton, take_step


def quadratic(condition=1e3, size=40):
    """A quadratic around (1, …, 1) in two parameters."""
    torch.manual_seed(0)
    basis, _ = torch.linalg.qr(torch.randn(size, size, dtype=torch.float64))
    hessian = (
        basis @ torch.diag(torch.logspace(0, torch.log10(torch.tensor(condition)), size, dtype=torch.float64)) @ basis.T
    )
    parts = [
        nn.Parameter(torch.zeros(size // 4, dtype=torch.float64)),
        nn.Parameter(torch.zeros(size - size // 4, dtype=torch.float64)),
    ]

    def loss():
        away = torch.cat(parts) - 1
        return 0.5 * away @ hessian @ away

    return parts, loss


def rosenbrock():
    parts = [nn.Parameter(torch.tensor([-1.2, 1.0], dtype=torch.float64))]
    return parts, lambda: (1 - parts[0][0]) ** 2 + 100 * (parts[0][1] - parts[0][0] ** 2) ** 2


@pytest.mark.parametrize(("problem", "num_steps"), [(quadratic, 200), (rosenbrock, 60)])
def test_it_finds_the_minimum(problem, num_steps):
    parts, loss = problem()
    optimiser = quasi_newton([{"params": parts, "lr": 0.1}])
    for _ in range(num_steps):
        assert take_step(optimiser, loss)
    for part in parts:
        torch.testing.assert_close(part.detach(), torch.ones_like(part), atol=1e-4, rtol=0)


def test_the_units_of_a_parameter_do_not_matter_if_its_scale_is_known():
    found = []
    for unit in (1.0, 1000.0):
        parts, loss = quadratic(condition=30.0)
        other = [parts[0], nn.Parameter(parts[1].detach() * unit)]
        optimiser = QuasiNewton([{"params": [other[0]], "lr": 0.1}, {"params": [other[1]], "lr": 0.1 * unit}])
        for _ in range(15):
            parts[1].data.copy_(other[1].data / unit)
            optimiser.zero_grad()
            parts[1].grad = None
            loss().backward()
            other[1].grad = parts[1].grad / unit
            optimiser.step()
        found.append(torch.cat([other[0].detach(), other[1].detach() / unit]))
    torch.testing.assert_close(found[0], found[1], rtol=1e-9, atol=1e-9)


def test_a_restored_optimiser_goes_on_as_before():
    parts, loss = quadratic()
    optimiser = QuasiNewton([{"params": parts, "lr": 0.1}])
    for _ in range(12):
        take_step(optimiser, loss)
    state, start = copy.deepcopy(optimiser.state_dict()), [part.detach().clone() for part in parts]
    ends = []
    for again in (optimiser, QuasiNewton([{"params": parts, "lr": 0.1}])):
        again.load_state_dict(copy.deepcopy(state))
        for part, value in zip(parts, start, strict=True):
            part.data.copy_(value)
        for _ in range(10):
            take_step(again, loss)
        ends.append(torch.cat(parts).detach().clone())
    torch.testing.assert_close(*ends, rtol=0, atol=0)


def test_a_parameter_without_a_gradient_stays():
    parts, loss = rosenbrock()
    idle = nn.Parameter(torch.ones(3, dtype=torch.float64))
    optimiser = QuasiNewton([{"params": [*parts, idle], "lr": 0.1}])
    for _ in range(10):
        take_step(optimiser, loss)
    assert torch.equal(idle.detach(), torch.ones(3, dtype=torch.float64))


def test_a_trained_noise_model_is_refused():
    with pytest.raises(ValueError, match="train_noise"):
        noiseflow.fit(noiseflow.Gaussian(), KnownSignal(torch.ones(500)), torch.rand(500), optimiser=quasi_newton)
