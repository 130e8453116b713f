"""Idle threads of programs sleep, and small operations use one thread."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

import noiseflow
from noiseflow import resources

_SHOW = "import os, sys; print(os.environ.get('OMP_WAIT_POLICY'), os.environ.get('OPENBLAS_NUM_THREADS'), 'numpy' in sys.modules)"
_PROGRAM = (
    "import sys; sys.argv = ['noiseflow', '-h']\n"
    "from noiseflow.commands.cli import main\n"
    f"try:\n    main()\nexcept SystemExit:\n    {_SHOW}"
)


def _environment(**settings: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in resources.SHARING} | settings


@pytest.mark.parametrize(
    ("settings", "policy"),
    [({}, "PASSIVE 1"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE 1"), ({"OPENBLAS_NUM_THREADS": "3"}, "PASSIVE 3")],
)
def test_a_program_waits_passively_from_the_start_unless_told_otherwise(settings: dict[str, str], policy: str) -> None:
    command = [sys.executable, "-c", _PROGRAM]
    said = subprocess.run(command, env=_environment(**settings), capture_output=True, text=True, check=True).stdout
    assert said.strip().splitlines()[-1] == f"{policy} False"


def test_the_napari_plugin_waits_passively() -> None:
    command = [sys.executable, "-c", f"import recon.napari; {_SHOW}"]
    said = subprocess.run(command, env=_environment(), capture_output=True, text=True, check=True).stdout
    assert said.split() == ["PASSIVE", "1", "True"]


@pytest.mark.parametrize(("size", "count"), [(4096, 1), (10**6, 2)])
def test_small_operations_use_one_thread(size: int, count: int) -> None:
    with resources.num_threads(2):
        with resources.few_threads(size):
            assert torch.get_num_threads() == count
        assert torch.get_num_threads() == 2


def test_a_fit_to_known_signals_uses_one_thread() -> None:
    seen = list[int]()
    signal = torch.linspace(1, 2, 4000)
    noise = noiseflow.Gaussian(0.1)(signal).sample(generator=torch.Generator().manual_seed(0))
    with resources.num_threads(2):
        options = {"num_steps": 8, "progress": lambda *_: seen.append(torch.get_num_threads())}
        noiseflow.fit(noiseflow.SplineFlow(), signal, noise, **options)
    assert set(seen) == {1}


@pytest.mark.parametrize(("policy", "load", "warned"), [("", 9.0, True), ("", 0.5, False), ("ACTIVE", 9.0, False)])
def test_spinning_on_a_busy_machine_is_reported(
    policy: str, load: float, warned: bool, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    for name in resources.PASSIVE:
        monkeypatch.delenv(name, raising=False)
    if policy:
        monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(resources, "_said", [])
    with resources.num_threads(2):
        resources.warn_if_spinning()
        resources.warn_if_spinning()
    assert [each.category for each in recwarn] == [RuntimeWarning] * warned
