"""A run goes on only with what it started from: the same images, angles, settings and version; and on its own random numbers."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

import noiseflow
import recon.commands.results  # noqa: F401  or every child process would import it again
from noiseflow import io
from recon.joint.checkpoint import Journal
from tests.processes import finish, start, wait_for


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a series and the state of a run that was killed."""
    folder = tmp_path_factory.mktemp("identity")
    finish(["simulate", folder / "new", "--size", 16, "--tilts=-60:60:10"], folder / "log")
    process = start(command(folder), folder / "log")
    wait_for((folder / "volume.npy.checkpoint" / "fit-001.safetensors").exists, process)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    return folder


def command(folder: Path) -> list[object]:
    return ["reconstruct", folder / "new" / "tilts.mrc", "-o", folder / "volume.npy", "--method", "l2", "--steps", 60]


def change_angle(folder: Path) -> None:
    angles = np.loadtxt(folder / "new" / "tilts.rawtlt")
    angles[3] += 0.25
    np.savetxt(folder / "new" / "tilts.rawtlt", angles)


def change_pixel(folder: Path) -> None:
    images = io.read(folder / "new" / "tilts.mrc").data.copy()
    images[3, 4, 5] += 0.01
    io.write(folder / "new" / "tilts.mrc", images)


def change_version(folder: Path) -> None:
    kept = json.loads((folder / "volume.npy.checkpoint" / "run.json").read_text())
    kept["library_version"] = "0.0.9"
    (folder / "volume.npy.checkpoint" / "run.json").write_text(json.dumps(kept))


@pytest.mark.parametrize(
    ("change", "words"),
    [(change_angle, "tilt series was"), (change_pixel, "tilt series was"), (change_version, "another version")],
)
def test_a_state_of_other_data_or_another_version_is_refused(stopped: Path, change, words: str, refused) -> None:
    files = ["new/tilts.rawtlt", "new/tilts.mrc", "volume.npy.checkpoint/run.json"]
    before = {name: (stopped / name).read_bytes() for name in files}
    change(stopped)
    try:
        assert words in refused(*command(stopped), "--resume")
        assert (stopped / "volume.npy.checkpoint" / "fit-001.safetensors").exists()
    finally:
        for name, content in before.items():
            (stopped / name).write_bytes(content)


def test_what_comes_after_a_finished_fit_draws_on_where_that_fit_ended(tmp_path: Path) -> None:
    """The finished fit is taken from the journal; the generator must stand where it left it."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(3000, generator=generator)
    observation = signal + 0.1 * torch.randn(3000, generator=generator)

    def two_fits(folder: str, *, resume: bool = False, stop: bool = False) -> torch.Tensor | None:
        torch.manual_seed(3)
        draws, journal = torch.Generator().manual_seed(1), Journal(tmp_path / folder, {}, resume=resume)
        models = [noiseflow.RadialFlow(2) for _ in range(2)]
        for number, model in enumerate(models):
            if number == 1 and stop:
                return None
            journal.fit(model, signal, observation, num_steps=12, batch_size=64, generator=draws)
        left = [torch.rand(3, generator=draws), torch.rand(3)]
        return torch.cat([*(p.detach().flatten() for p in models[1].parameters()), *left])

    whole = two_fits("whole")
    two_fits("stopped", stop=True)
    found = two_fits("stopped", resume=True)
    assert whole is not None
    assert found is not None
    torch.testing.assert_close(found, whole, rtol=0, atol=0)
