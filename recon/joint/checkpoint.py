"""Checkpoints of a reconstruction: the state of every fit, so that interrupted runs resume.

A journal is a folder of safetensors files with JSON metadata, written atomically. Opening one runs no code from it.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow import FitResult, fit
from noiseflow.fitting.observation_table import TableKeeper
from noiseflow.installation import library_version
from noiseflow.io import atomic_path, output_folder
from noiseflow.io.ownership import is_own
from noiseflow.io.partials import clear_all_leftovers
from noiseflow.progress import Progress
from recon.joint.stages import Stage
from recon.joint.state_files import discard_states, is_state
from recon.joint.state_files import read_state as read_state
from recon.joint.state_files import write_state as write_state

_FORMAT = "noiseflow checkpoint 2"
_RUN_START = b'{\n "format": "noiseflow checkpoint '
_RUN, _CURRENT, _BLOCKS = "run.json", "current.safetensors", "blocks-"
_ROW = "[0-9]" * 7
_RESULT = [field.name for field in fields(FitResult) if field.name not in ("noise_model", "digitisation")]


class Journal:
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
        self.folder, self.interval, self.report = Path(folder), interval, report
        self.settings, self._choices = json.loads(json.dumps(settings)), dict[str, Any]()
        self.stop_requested = self.abandoned = self.in_fit = False
        self._fresh = not (resume and self.exists)
        if not self._fresh:
            self._check_settings()

    @property
    def exists(self) -> bool:
        """Whether the folder holds a journal."""
        return (self.folder / _RUN).is_file()

    @property
    def resumed(self) -> bool:
        """Whether this run continues an earlier one."""
        return not self._fresh

    def choose(self, name: str, find: Callable[[], Any]) -> Any:
        """Return the JSON-serialisable result of `find`, or the one that the run stored before it was interrupted, so that a
        resumed run does not depend on the state of the machine. Must be called before anything is written."""
        if name not in self._choices:
            self._choices[name] = find()
        return self._choices[name]

    def fit(
        self, name: str, noise_model: nn.Module, signal: Tensor | nn.Module, observation: Tensor, **options: Any
    ) -> FitResult:
        """Run `noiseflow.fit`, or load its result stored under this name; other arguments and errors are the same."""
        finished, generator = self._finished(name), options.get("generator")
        models = {"noise_model": noise_model} | ({"signal_model": signal} if isinstance(signal, nn.Module) else {})
        if not self._fresh and finished.exists():
            return _replay(read_state(finished), models, generator, options.get("tables"))
        options |= {
            "resume": self._current(name),
            "checkpoint": partial(self._write_current, name),
            "checkpoint_interval": self.interval,
            "digitise": False,
            "progress": self._stopping(name, options.get("progress")),
        }
        with self._working():
            result = fit(noise_model, signal, observation, **options)
        tables: TableKeeper | None = options.get("tables")
        self._write(
            finished,
            {part: model.state_dict() for part, model in models.items()}
            | {"result": {part: getattr(result, part) for part in _RESULT}, "rng": torch.get_rng_state()}
            | ({"generator": generator.get_state()} if generator is not None else {})
            | ({"tables": tables.state()} if tables is not None else {}),
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

    def keep(self, prefix: str = "") -> Path:
        """The folder for finished blocks of a volume, named after the prefix of its fits; removed with the journal."""
        if self._fresh:
            self._start()
        return self.folder / f"{_BLOCKS}{hashlib.blake2b(prefix.encode(), digest_size=4).hexdigest()}"

    def forget(self, prefix: str) -> None:
        """Remove the states of fits with this prefix, whose block is stored and smaller than they are."""
        for file in filter(is_state, self.folder.glob(f"{_slug(prefix)}*.safetensors")):
            file.unlink()

    def discard(self) -> None:
        """Remove the journal of a complete or abandoned run."""
        for blocks in self.folder.glob(f"{_BLOCKS}{'[0-9a-f]' * 8}"):
            clear_all_leftovers(blocks)
            for file in blocks.glob(f"*-{_ROW}-{_ROW}.npy"):
                if is_own(file):
                    file.unlink()
            if not any(blocks.iterdir()):
                blocks.rmdir()
        discard_states(self.folder, _RUN)

    def _finished(self, name: str) -> Path:
        digest = hashlib.blake2b(name.encode(), digest_size=4).hexdigest()
        return self.folder / f"{_slug(name)}-{digest}.safetensors"

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

    def _write(self, path: Path, state: dict[str, Any]) -> None:
        if self._fresh:
            self._start()
        write_state(path, state)

    def _start(self) -> None:
        self._require_own()
        self.discard()
        description = {"format": _FORMAT, "library_version": library_version(), "settings": self.settings}
        description["choices"] = self._choices
        with output_folder(self.folder, parents=False), atomic_path(self.folder / _RUN) as partial:
            partial.write_text(json.dumps(description, indent=1), encoding="utf-8")
        self._fresh = False

    def _require_own(self) -> None:
        run = self.folder / _RUN
        head = run.read_bytes()[: len(_RUN_START)] if run.is_file() else b""
        if head and head != _RUN_START:
            raise FileExistsError(
                f"{run} was not written by noiseflow and would be overwritten; move it, or name another output"
            )

    def _check_settings(self) -> None:
        advice = f"give the same input and options, or remove --resume to start over ({self.folder})"
        try:
            kept = json.loads((self.folder / _RUN).read_text(encoding="utf-8"))
            format_, settings = kept["format"], dict(kept["settings"])
            self._choices = dict(kept.get("choices", {}))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"the checkpoint's {_RUN} is damaged; {advice}") from error
        if format_ != _FORMAT or kept.get("library_version") != library_version():
            raise ValueError(f"the checkpoint was written by another version of noiseflow; {advice}")
        names = [name for name in {**settings, **self.settings} if settings.get(name) != self.settings.get(name)]
        if names:
            changes = ", ".join(f"{name} was {settings.get(name)}, now {self.settings.get(name)}" for name in names)
            raise ValueError(f"the checkpoint is of another run: {changes}; {advice}")


def _slug(name: str) -> str:
    return re.sub("[^a-z0-9.]+", "-", name.lower())[:60]


def _replay(
    kept: dict[str, Any],
    models: dict[str, nn.Module],
    generator: torch.Generator | None,
    tables: TableKeeper | None,
) -> FitResult:
    for name, model in models.items():
        model.load_state_dict(kept[name])
    if generator is not None:
        generator.set_state(kept["generator"])
    if tables is not None:
        tables.table, tables.resume = None, kept["tables"]
    torch.set_rng_state(kept["rng"])
    return FitResult(models["noise_model"], **kept["result"])
