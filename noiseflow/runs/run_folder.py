"""The folder of a run that can be interrupted: what determines the run, and the states that it resumes from."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from noiseflow.installation import library_version
from noiseflow.runs.outputs import atomic_path, output_folder
from noiseflow.runs.ownership import is_own
from noiseflow.runs.partials import clear_all_leftovers
from noiseflow.runs.states import discard_states, is_state, write_state

_FORMAT = "noiseflow checkpoint 2"
_RUN_START = b'{\n "format": "noiseflow checkpoint '
_RUN, _BLOCKS = "run.json", "blocks-"
_ROW = "[0-9]" * 7


class RunFolder:
    """Settings of a run, choices that it made, and states by name, each written atomically.

    Args:
        folder: created with the first state.
        settings: JSON-serialisable settings that determine the result, by name. A folder with other settings is rejected.
        resume: continue from the contents of the folder; otherwise the first state replaces them.

    Raises:
        ValueError: the folder belongs to a run with other settings, or is damaged.
    """

    def __init__(self, folder: str | Path, settings: dict[str, Any], *, resume: bool = False) -> None:
        self.folder = Path(folder)
        self.settings, self._choices = json.loads(json.dumps(settings)), dict[str, Any]()
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
