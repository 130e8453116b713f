"""A reconstruction that was stopped, by Ctrl-C or by kill -9, goes on and ends in the same volume."""

import json
import os
import random
import re
import signal
import time

import numpy as np
import pytest
import torch

import noiseflow
import recon
import recon.commands.results
from noiseflow import io
from noiseflow.fitting.loop import FitLoop
from noiseflow.runs.run_folder import read_state, write_state
from recon.fields.fields import find_field
from recon.joint.checkpoint import Journal, Repeated
from tests.processes import finish, start, wait_for


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    folder = tmp_path_factory.mktemp("resume")
    finish(["simulate", folder / "new", "--size", 16, "--tilts=-60:60:10"], folder / "log")
    return folder / "new" / "tilts.mrc"


def command(series, out, *more):
    options = ["--method", "l2", "--weight", 0.4, "--steps", 60, "--checkpoint-interval", 0.1]
    return ["reconstruct", series, "-o", out, *options, *more]


@pytest.fixture(scope="module")
def whole(series, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    started = time.monotonic()
    text = finish(command(series, folder / "volume.npy", "--resume"), folder / "log")
    assert "starting from the beginning" in text
    assert "memory: about" in text
    return np.load(folder / "volume.npy"), time.monotonic() - started


def finished_fits(folder):
    """What the journal keeps of fits that are done."""
    return sorted((folder / "volume.npy.checkpoint").glob("[!c]*.safetensors"))


def same(found, expected):
    return np.abs(found - expected).max() <= 1e-5 * np.abs(expected).max()


def kill(process):
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
        process.join()


def require_whole(*outputs):
    """Outputs are whole or not there."""
    for path in outputs:
        if path.exists():
            noiseflow.load(path) if path.suffix == ".safetensors" else io.read(path)


def kill_and_resume(series, whole, folder, kills, randomness):
    """The volume of a run that was killed at random moments; all files are whole after each, and no state is left at the end."""
    seconds = whole[1]
    out, model, more = folder / "volume.npy", folder / "model.safetensors", []
    for _ in range(kills):
        process = start(command(series, out, "--save-noise-model", model, *more), folder / "log")
        process.join(randomness.uniform(0, 1.1 * seconds / max(1, kills / 3)))
        kill(process)
        require_whole(out, model)
        more = ["--resume"]
    finish(command(series, out, "--save-noise-model", model, *more), folder / "log")
    require_whole(model)
    assert not (folder / "volume.npy.checkpoint").exists()
    return np.load(out)


def test_two_kills_at_random_moments_lose_nothing(series, whole, tmp_path):
    assert same(kill_and_resume(series, whole, tmp_path, 2, random.Random(1)), whole[0])


@pytest.mark.slow
def test_thirty_kills_at_random_moments_lose_nothing(series, whole, tmp_path):
    for seed in range(6):
        (tmp_path / str(seed)).mkdir()
        assert same(kill_and_resume(series, whole, tmp_path / str(seed), 5, random.Random(seed)), whole[0])


@pytest.mark.slow
def test_kills_lose_no_finished_block_and_change_not_a_bit(series, tmp_path):
    def blocks(out):
        return {
            file: file.stat().st_mtime_ns for file in out.with_name(f"{out.name}.checkpoint").glob("blocks-*/*.npy")
        }

    out, more, known = tmp_path / "volume.npy", ["--slices-at-once", 4], {}
    finish(command(series, tmp_path / "whole.npy", *more), tmp_path / "log")
    for least in (2, 4, 6):  # two files each
        process = start(command(series, out, *more), tmp_path / "log")
        wait_for(lambda least=least: len(blocks(out)) >= least, process)
        kill(process)
        found = blocks(out)
        assert known.items() <= found.items()
        known, more = found, ["--slices-at-once", 4, "--resume"]
    finish(command(series, out, *more), tmp_path / "log")
    np.testing.assert_array_equal(np.load(out), np.load(tmp_path / "whole.npy"))


def steps_told(log):
    """(title, step, steps) of every line of progress."""
    found = re.findall(r"^(.*): (\d+)/(\d+), ", log.read_text(), re.MULTILINE)
    return [(title, int(done), int(total)) for title, done, total in found]


@pytest.fixture
def steps_taken(monkeypatch, tmp_path):
    """The steps of fits and other stages that commands take, "title number" each; commands are forked, so this reaches them.

    Without the coarse start, which no journal keeps: it is found again in a moment.
    """
    file, titles = tmp_path / "steps", [""]
    fit, run_stage, take_step = Journal.fit, Journal.run_stage, FitLoop._take_step

    def note(number):
        if not titles[-1]:
            return
        with file.open("a") as stream:
            stream.write(f"{titles[-1]} {number}\n")

    def named(self, name, *arguments, **options):
        titles.append(name)
        result = fit(self, name, *arguments, **options)
        titles.pop()
        return result

    def noted(self, step, schedule):
        note(step)
        return take_step(self, step, schedule)

    def staged(self, title, stage):
        step = stage.step
        monkeypatch.setattr(stage, "step", lambda: (note(stage.done + 1), step())[1])
        titles.append(title)
        result = run_stage(self, title, stage)
        titles.pop()
        return result

    monkeypatch.setattr(Journal, "fit", named)
    monkeypatch.setattr(FitLoop, "_take_step", noted)
    monkeypatch.setattr(Journal, "run_stage", staged)

    def taken():
        return file.read_text().splitlines() if file.exists() else []

    return taken


@pytest.mark.parametrize("method", ["l2", "sirt", "wbp-denoised"])
def test_a_kill_costs_the_step_at_hand_and_no_other(series, tmp_path, method, steps_taken):
    """With no time between checkpoints: what the killed run and the one after it took are the steps of an unbroken one."""
    out = tmp_path / "volume.npy"
    fast = ["reconstruct", series, "-o", out, "--method", method, "--checkpoint-interval", 0]
    fast += ["--denoiser", "tv"] if method == "wbp-denoised" else ["--steps", 20]
    finish(fast, tmp_path / "log")
    expected, volume = steps_taken(), np.load(out)
    out.unlink()
    process = start(fast, tmp_path / "log")
    wait_for(lambda: len(steps_taken()) >= len(expected) * 4 / 3, process)
    kill(process)
    begun = steps_taken()[len(expected) :]
    assert begun == expected[: len(begun)]
    finish([*fast, "--resume"], tmp_path / "log")
    rest = steps_taken()[len(expected) + len(begun) :]
    assert rest in (expected[len(begun) - 1 :], expected[len(begun) :])
    assert same(np.load(out), volume)  # one more step left out would be seen here


def test_sirt_goes_on(series, tmp_path):
    options = ["--method", "sirt", "--steps", 12, "--checkpoint-interval", 0]
    finish(["reconstruct", series, "-o", tmp_path / "whole.npy", *options], tmp_path / "log")
    out = tmp_path / "volume.npy"
    process = start(["reconstruct", series, "-o", out, *options], tmp_path / "log")
    wait_for(lambda: len(steps_told(tmp_path / "log")) >= 2, process)
    kill(process)
    finish(["reconstruct", series, "-o", out, *options, "--resume"], tmp_path / "log")
    assert same(np.load(out), np.load(tmp_path / "whole.npy"))


def test_ctrl_c_saves_and_says_how_to_go_on(series, whole, tmp_path):
    out, log = tmp_path / "volume.npy", tmp_path / "log"
    process = start(command(series, out), log)
    wait_for(lambda: len(finished_fits(tmp_path)) >= 2, process)
    os.kill(process.pid, signal.SIGINT)
    process.join(60)
    assert process.exitcode == 130, log.read_text()
    assert not out.exists()
    last = log.read_text().strip().splitlines()[-1]
    assert f"noiseflow {' '.join(map(str, command(series, out)))} --resume" in last
    finish(command(series, out, "--resume"), log)
    assert same(np.load(out), whole[0])


def test_ctrl_c_twice_leaves_the_last_checkpoint(series, tmp_path):
    out, log = tmp_path / "volume.npy", tmp_path / "log"
    process = start(command(series, out), log)
    wait_for(lambda: finished_fits(tmp_path), process)
    kept = finished_fits(tmp_path)[0]
    for _ in range(2):
        os.kill(process.pid, signal.SIGINT)
    process.join(60)
    assert process.exitcode == 130, log.read_text()
    assert read_state(kept)["result"][
        "history"
    ]  # measured before any step, which a noise that is at its maximum does not need
    assert log.read_text().strip().splitlines()[-1].endswith("--resume")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("field", ["network", "gaussians"])
def test_a_field_that_was_never_saved_ends_in_the_same_volume(series, tmp_path, field, number, monkeypatch):
    """Stopped when it has learnt the rough volume, after the first step of the first fit, and amid its own fit."""
    out, log, kind = tmp_path / "volume.npy", tmp_path / "log", find_field(field)
    ours = command(series, out, "--field", field, "--steps", 12, "--checkpoint-interval", 1e6)
    finish(ours, log)
    expected = np.load(out)
    for owner, name, count in ((kind, "start_from", 1), (Journal, "_after_step", 1), (kind, "units", 9)):
        out.unlink()
        called, left = getattr(owner, name), list(range(count))

        def stopping(*arguments, called=called, left=left, **options):
            found = called(*arguments, **options)
            if left and not left[:-1]:
                os.kill(os.getpid(), number)
            del left[:1]
            return found

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, stopping)
            process = start(ours, log)
            process.join(60)
        assert process.exitcode == (130 if number == signal.SIGINT else -number), log.read_text()
        kept = (owner is Journal and number == signal.SIGINT) or name == "units"
        assert out.with_name("volume.npy.checkpoint").exists() == kept
        assert ("starting from the beginning" in finish([*ours, "--resume"], log)) != kept
        assert same(np.load(out), expected)


def test_another_run_is_not_gone_on_with(series, tmp_path, refused):
    out = tmp_path / "volume.npy"
    process = start(command(series, out), tmp_path / "log")
    wait_for(lambda: finished_fits(tmp_path), process)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    message = refused(*command(series, out, "--seed", 5, "--resume"))
    assert "seed was 0, now 5" in message
    assert finished_fits(tmp_path)
    (tmp_path / "volume.npy.checkpoint" / "run.json").write_text("{")
    assert "damaged" in refused(*command(series, out, "--resume"))


def fits(journal, steps=30):
    """Two fits in order, the second starting from the first, as a reconstruction does."""
    torch.manual_seed(3)
    generator = torch.Generator().manual_seed(1)
    observation = torch.rand(4, 40, 40, generator=generator) + torch.linspace(0, 1, 40)
    scene, first, second = noiseflow.StaticScene(observation), noiseflow.Gaussian(), noiseflow.RadialFlow()
    for name, model in (("first", first), ("second", second)):
        journal.fit(name, model, scene, observation, num_steps=steps, generator=generator)
    return scene.image().detach(), torch.cat([p.detach().flatten() for p in second.parameters()])


def test_journal_ends_where_an_unbroken_run_does_wherever_it_stopped(tmp_path):
    expected = fits(Journal(tmp_path / "whole", {}))
    for stop in (1, 17, 30, 31, 44, 60):
        count = iter(range(1, 1000))

        def report(*_, count=count, stop=stop):
            if next(count) == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            fits(Journal(tmp_path / str(stop), {}, report=report))
        found = fits(Journal(tmp_path / str(stop), {}, resume=True))
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)


def moving_gaussians(journal):
    """A fit of Gaussians that move after 15 and 30 steps."""
    density = torch.zeros(10, 10, 10)
    density[2:4, 3:7, 5:8] = 1.0
    projector = recon.SliceProjector(tilt_angles=np.arange(-60, 61, 20.0), depth=10, width=10)
    field = recon.GaussianField((10, 10, 10), count=60)
    model = recon.TomographySignal(field, projector, recon.Transmission(1.0), weight=0.1)
    observation = torch.exp(-projector(density)).transpose(1, 2).contiguous()
    noise, generator = noiseflow.Gaussian(0.05).requires_grad_(False), torch.Generator().manual_seed(1)
    journal.fit("fit", noise, model, observation, num_steps=40, generator=generator, standardise=False)
    return field.centre.detach(), field.volume()


@pytest.mark.slow
def test_gaussians_move_alike_wherever_a_fit_stopped(tmp_path):
    expected = moving_gaussians(Journal(tmp_path / "whole", {}))
    for stop in (14, 15, 16, 31):
        count = iter(range(1, 1000))

        def report(*_, count=count, stop=stop):
            if next(count) == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            moving_gaussians(Journal(tmp_path / str(stop), {}, report=report))
        found = moving_gaussians(Journal(tmp_path / str(stop), {}, resume=True))
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)


def test_a_stage_that_was_stopped_goes_on(tmp_path):
    def growing(num_steps):
        return Repeated(torch.ones(3), lambda value, done: 2 * value + done, num_steps)

    journal = Journal(tmp_path / "run", {})
    journal.report = lambda title, done, total, note: setattr(journal, "stop_requested", done == 4)
    with pytest.raises(KeyboardInterrupt, match="after step 4 of 9"):
        journal.run_stage("growing", growing(9))
    told = []
    again, stage = Journal(tmp_path / "run", {}, resume=True, report=lambda *words: told.append(words[1])), growing(9)
    again.run_stage("growing", stage)
    assert told == [5, 6, 7, 8, 9]
    whole = growing(9)
    Journal(tmp_path / "other", {}).run_stage("growing", whole)
    assert torch.equal(stage.value, whole.value)


def test_first_write_of_a_new_run_replaces_the_old_journal(tmp_path):
    fits(Journal(tmp_path / "run", {"seed": 0}), steps=3)
    journal = Journal(tmp_path / "run", {"seed": 1})
    assert not journal.resumed
    assert len(list((tmp_path / "run").glob("[!c]*.safetensors"))) == 2
    journal.fit("another", noiseflow.Gaussian(), torch.rand(200), torch.rand(200), num_steps=2)
    assert len(list((tmp_path / "run").glob("[!c]*.safetensors"))) == 1
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"] == {"seed": 1}
    journal.discard()
    assert not (tmp_path / "run").exists()


def test_state_survives_the_file_and_damage_is_told(tmp_path):
    grid = torch.arange(12.0).view(3, 4)
    state = {"a": [1, None, True, "x"], 3: {"inf": float("inf")}, "whole": grid, "view": grid[1:, 1], "same": grid}
    write_state(tmp_path / "state.safetensors", state)
    back = read_state(tmp_path / "state.safetensors")
    assert list(back) == list(state)
    assert back["a"] == state["a"]
    assert back[3] == state[3]
    for name in ("whole", "view", "same"):
        torch.testing.assert_close(back[name], state[name])
    data = (tmp_path / "state.safetensors").read_bytes()
    (tmp_path / "state.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="damaged"):
        read_state(tmp_path / "state.safetensors")
