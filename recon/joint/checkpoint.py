"""Checkpoints of a reconstruction: the state of every fit, so that interrupted runs resume.

A journal is a folder of safetensors files with JSON metadata, written atomically. Opening one runs no code from it.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from noiseflow import FitResult, fit
from noiseflow.progress import Progress
from noiseflow.runs.run_folder import RunFolder, read_state


class Stage(Protocol):
    """A computation in steps.

    Attributes:
        done: completed steps.
        num_steps: total number of steps; a stage that finishes early reduces it.
    """

    done: int
    num_steps: int

    def step(self) -> str:
        """Take the next step. Return a short note, such as the current loss."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything that further steps depend on: nested dicts and lists of tensors, numbers and strings."""
        ...

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        ...


RunStage = Callable[[str, Stage], None]
"""``run_stage(title, stage)`` takes all remaining steps."""


def run_stage(title: str, stage: Stage) -> None:
    """Take all remaining steps; `recon.joint.checkpoint.Journal.run_stage` also reports progress and saves states."""
    del title
    while stage.done < stage.num_steps:
        stage.step()


class Repeated:
    """Repeated application of a function to a tensor.

    Args:
        advance: function from the tensor and the number of completed steps to the next tensor.
    """

    def __init__(self, start: Tensor, advance: Callable[[Tensor, int], Tensor], num_steps: int) -> None:
        self.value, self.advance, self.done, self.num_steps = start, advance, 0, num_steps

    def step(self) -> str:
        """Advance once."""
        self.value = self.advance(self.value, self.done)
        self.done += 1
        return ""

    def state(self) -> dict[str, Any]:
        """The tensor and the number of steps."""
        return {"value": self.value, "done": self.done}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore tensor and number of steps."""
        self.value, self.done = state["value"].to(self.value), state["done"]


_CURRENT = "current.safetensors"
_RESULT = [field.name for field in fields(FitResult) if field.name not in ("noise_model", "digitisation")]


class Journal(RunFolder):
    """Runs the fits and other stages of one reconstruction in order, and stores their results and states.

    A reconstruction is determined by its settings, its seed and the results of its stages, which are stored by name. A resumed
    run repeats everything else, loads the results of finished stages, and continues the interrupted one.

    Args:
        folder: folder of the journal; created with the first checkpoint.
        settings: JSON-serialisable settings that determine the result, by name. A journal with other settings is rejected.
        resume: continue from the contents of the folder; otherwise the first checkpoint replaces them.
        interval: seconds between checkpoints within a stage; a stage is also saved when it ends or is stopped.
        report: called after every step. It may raise KeyboardInterrupt; the completed step is then saved.

    Attributes:
        in_fit: whether a fit or another stage is running.
        stop_requested: set it to raise KeyboardInterrupt after the current step, with its state saved.
        abandoned: set it to prevent any further writing.

    Raises:
        ValueError: the folder belongs to a run with other settings, or is damaged.
    """

    def __init__(
        self,
        folder: str | Path,
        settings: dict[str, Any],
        *,
        resume: bool = False,
        interval: float = 60.0,
        report: Progress | None = None,
    ) -> None:
        super().__init__(folder, settings, resume=resume)
        self.interval, self.report = interval, report
        self.stop_requested = self.abandoned = self.in_fit = False

    def fit(
        self, name: str, noise_model: nn.Module, signal: Tensor | nn.Module, observation: Tensor, **options: Any
    ) -> FitResult:
        """Run `noiseflow.fit`, or load its result stored under this name; other arguments and errors are the same."""
        finished, generator = self._finished(name), options.get("generator")
        models = {"noise_model": noise_model} | ({"signal_model": signal} if isinstance(signal, nn.Module) else {})
        if not self._fresh and finished.exists():
            return _replay(read_state(finished), models, generator)
        options |= {
            "resume": self._current(name),
            "checkpoint": partial(self._write_current, name),
            "checkpoint_interval": self.interval,
            "digitise": False,
            "progress": self._stopping(name, options.get("progress")),
        }
        with self._working():
            result = fit(noise_model, signal, observation, **options)
        self._write(
            finished,
            {part: model.state_dict() for part, model in models.items()}
            | {"result": {part: getattr(result, part) for part in _RESULT}, "rng": torch.get_rng_state()}
            | ({"generator": generator.get_state()} if generator is not None else {}),
        )
        (self.folder / _CURRENT).unlink(missing_ok=True)
        return result

    def run_stage(self, title: str, stage: Stage) -> None:
        """Take the remaining steps of a stage, with progress and checkpoints as for a fit."""
        finished = self._finished(title)
        if not self._fresh and finished.exists():
            stage.load_state(read_state(finished))
            return
        current = self._current(title)
        if current is not None:
            stage.load_state(current)
        with self._working():
            saved = time.perf_counter()
            try:
                while stage.done < stage.num_steps:
                    note = stage.step()
                    if time.perf_counter() - saved >= self.interval:
                        self._write_current(title, stage.state())
                        saved = time.perf_counter()
                    self._after_step(title, stage.done, stage.num_steps, note)
            except KeyboardInterrupt:
                self._write_current(title, stage.state())
                raise
        self._write(finished, stage.state())
        (self.folder / _CURRENT).unlink(missing_ok=True)

    @contextmanager
    def _working(self) -> Iterator[None]:
        """Mark a fit or stage as running, so that a stop waits for the end of its step; it stays marked if interrupted."""
        self.in_fit = True
        yield
        self.in_fit = False

    def _stopping(self, name: str, own: Progress | None) -> Progress:
        """The progress callback of a fit, which also stops it if requested."""

        def progress(task: str, done: int, total: int, note: str) -> None:
            if own is not None:
                own(task, done, total, note)
            self._after_step(name, done, total, note, reported=own is not None)

        return progress

    def _after_step(self, title: str, done: int, total: int, note: str, *, reported: bool = False) -> None:
        if self.report is not None and not reported:
            self.report(title, done, total, note)
        if self.stop_requested:
            raise KeyboardInterrupt(f"stopped after step {done} of {total} ({title})")

    def _current(self, name: str) -> dict[str, Any] | None:
        if self._fresh or not (self.folder / _CURRENT).exists():
            return None
        kept = read_state(self.folder / _CURRENT)
        if kept["name"] != name:
            return None
        torch.set_rng_state(kept["rng"])
        state: dict[str, Any] = kept["fit"]
        return state

    def _write_current(self, name: str, state: dict[str, Any]) -> None:
        if not self.abandoned:
            self._write(self.folder / _CURRENT, {"name": name, "fit": state, "rng": torch.get_rng_state()})


def _replay(kept: dict[str, Any], models: dict[str, nn.Module], generator: torch.Generator | None) -> FitResult:
    for name, model in models.items():
        model.load_state_dict(kept[name])
    if generator is not None:
        generator.set_state(kept["generator"])
    torch.set_rng_state(kept["rng"])
    return FitResult(models["noise_model"], **kept["result"])
