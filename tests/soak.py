"""Each command in a loop with random faults: kills, full disks, two at a time, read-only folders, truncated input.

    python -m tests.soak --seconds 3600 --report soak.md

After every round: a user's file that lay there is unchanged; outputs are whole or absent; nothing else is left once a clean run
has followed a fault; a resumed run ends in the volume of an unbroken one; and the memory of one process that runs the commands
again and again stays flat. Exits with 1 where any of that fails.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

import noiseflow
from noiseflow import io
from tests.bad_files import make_good_files

COMMANDS = {
    "sample": "sample {good}/model.safetensors {good}/clean.mrc -o {out}/noisy.tif",
    "simulate": "simulate {out}/new --size 24 --tilts=-60:60:10",
    "reconstruct": "reconstruct {good}/tilts.mrc -o {out}/v.npy --method l2 --weight 0.4 --steps 40 --checkpoint-interval 0.1",
    "blocks": "reconstruct {good}/tilts.mrc -o {out}/b.mrc --method sirt --steps 60 --slices-at-once 8",
    "compare": "compare {good}/tilts.mrc {good}/other.mrc --report {out}/page",
    "calibrate": "calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/m.safetensors --kind gaussian",
}
MEMORY_COMMANDS = ("sample", "simulate", "compare")
MOST_GROWTH = 30
"""MiB between the third round of one process and its last: caches fill in the first two."""
_LONGEST = 300


class Soak:
    """The loop, and what it found."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.good, self.folder, self.choose = folder / "good", folder, random.Random(seed)
        self.rounds: Counter[str] = Counter()
        self.faults: list[str] = []
        self.expected: dict[str, str] = {}
        self.seconds: dict[str, float] = {}
        self.good.mkdir()
        make_good_files(self.good)
        stack = io.read(self.good / "tilts.mrc").data
        io.write(self.good / "other.mrc", stack + np.float32(0.01) * np.arange(stack.shape[2], dtype=np.float32))
        self.inputs = self._digests(self.good)
        self.scenarios: dict[str, Callable[[str, Path], None]] = {
            "kill": self._kill,
            "interrupt": self._interrupt,
            "full disk": self._full_disk,
            "two at a time": self._two,
            "read-only folder": self._read_only,
            "truncated input": self._truncated,
            "closed output": self._closed,
        }

    def round(self) -> None:
        """One command with one fault, and all that must hold after it."""
        name, fault = self.choose.choice(sorted(COMMANDS)), self.choose.choice(sorted(self.scenarios))
        out = Path(tempfile.mkdtemp(dir=self.folder, prefix="round-"))
        mine = out / "mine.safetensors"
        mine.write_bytes(b"years of work")
        self.rounds[f"{name}, {fault}"] += 1
        try:
            self.scenarios[fault](name, out)
            self._clean_run(name, out)
            self._require(mine.read_bytes() == b"years of work", "the user's file is gone")
            self._require(self._digests(self.good) == self.inputs, "an input was changed")
            hidden = [path.name for path in out.rglob(".*")] + [path.name for path in out.glob("*.checkpoint")]
            self._require(not hidden, f"left behind: {hidden}")
        except AssertionError as error:
            self.faults.append(f"{name}, {fault}: {error}")
        finally:
            out.chmod(0o700)
            shutil.rmtree(out, ignore_errors=True)

    def _start(self, name: str, out: Path, more: str = "", **options: object) -> subprocess.Popen[str]:
        words = shlex.split(COMMANDS[name].format(good=options.pop("good", self.good), out=out) + more)
        both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, **options}
        return subprocess.Popen([sys.executable, "-m", "noiseflow", *words], text=True, start_new_session=True, **both)  # type: ignore[call-overload,no-any-return]

    def _end(self, process: subprocess.Popen[str], *codes: int) -> str:
        try:
            printed, _ = process.communicate(timeout=_LONGEST)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise AssertionError(f"still running after {_LONGEST} s") from None
        printed = printed or ""
        self._require(process.returncode in codes, f"exit code {process.returncode}: {printed[-300:]}")
        self._require("Traceback" not in printed and "bug in noiseflow" not in printed, printed[-300:])
        return printed

    def _clean_run(self, name: str, out: Path) -> None:
        """The same command without a fault; a reconstruction goes on where it was."""
        started = time.monotonic()
        self._end(self._start(name, out, " --resume" if name in ("reconstruct", "blocks") else ""), 0)
        self.seconds.setdefault(name, time.monotonic() - started)
        found = self._result(name, out)
        self._require(found == self.expected.setdefault(name, found), "another result than that of the first run")

    def _result(self, name: str, out: Path) -> str:
        if name in ("reconstruct", "blocks"):  # a resumed one may differ in the last digits
            volume = io.read(out / ("v.npy" if name == "reconstruct" else "b.mrc")).data
            return str(np.round(volume / np.abs(volume).max(), 3).astype(np.float32).sum(dtype=np.float64).round(0))
        files = {"sample": "noisy.tif", "simulate": "new/tilts.mrc", "calibrate": "m.safetensors"}
        if name not in files:
            return str((out / "page" / "index.html").is_file())
        path = out / files[name]
        if path.suffix == ".safetensors":
            return type(noiseflow.load(path)).__name__
        return hashlib.sha256(io.read(path).data.tobytes()).hexdigest()

    def _moment(self, name: str) -> float:
        return self.choose.uniform(0.5, 1.2) * self.seconds.get(name, 8.0)

    def _stopped(self, name: str, out: Path, number: signal.Signals) -> subprocess.Popen[str]:
        process = self._start(name, out)
        try:
            process.wait(self._moment(name))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, number)
        return process

    def _kill(self, name: str, out: Path) -> None:
        self._end(self._stopped(name, out, signal.SIGKILL), 0, -signal.SIGKILL)

    def _interrupt(self, name: str, out: Path) -> None:
        self._end(self._stopped(name, out, signal.SIGINT), 0, 130)

    def _full_disk(self, name: str, out: Path) -> None:
        size = self.choose.choice([600, 3000, 20_000])

        def limit() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        self._end(self._start(name, out, preexec_fn=limit), 0, 1)

    def _two(self, name: str, out: Path) -> None:
        both = [self._start(name, out) for _ in range(2)]
        printed = [self._end(process, 0, 1) for process in both]
        self._require(0 in [process.returncode for process in both], f"neither of two ended well: {printed}")

    def _read_only(self, name: str, out: Path) -> None:
        out.chmod(0o500)
        self._end(self._start(name, out), 0, 1)  # root may write there
        out.chmod(0o700)

    def _truncated(self, name: str, out: Path) -> None:
        bad = out / "input"
        shutil.copytree(self.good, bad)
        for path in bad.iterdir():
            whole = path.read_bytes()
            path.write_bytes(whole[: self.choose.randrange(len(whole))])
        self._end(self._start(name, out, good=bad), 0, 1)
        shutil.rmtree(bad)

    def _closed(self, name: str, out: Path) -> None:
        line = COMMANDS[name].format(good=self.good, out=out)
        closed = self.choose.choice(["2>&-", ">&-", "| true; exit ${PIPESTATUS[0]}"])
        words = ["bash", "-c", f"{shlex.quote(sys.executable)} -m noiseflow {line} {closed}"]
        self._end(subprocess.Popen(words, text=True, stdout=subprocess.PIPE, start_new_session=True), 0)

    def memory(self, seconds: float) -> str:
        """How the memory of one process grows that runs commands again and again."""
        program = (
            "import resource, sys, time\nfrom tests.soak import MEMORY_COMMANDS, COMMANDS\n"
            "from noiseflow.commands.cli import main\n"
            "end, out = time.monotonic() + float(sys.argv[3]), []\n"
            "while len(out) < 6 or time.monotonic() < end:\n"
            "    for name in MEMORY_COMMANDS:\n"
            "        try:\n            main(COMMANDS[name].format(good=sys.argv[1], out=sys.argv[2]).split() + ['--json'])\n"
            "        except SystemExit as end_of_command:\n            assert not end_of_command.code, name\n"
            "    out.append(int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize() / 2**20)\n"
            "print('MEMORY', len(out), out[2], max(out[-3:]))\n"
        )
        out = self.folder / "memory"
        out.mkdir()
        words = [sys.executable, "-c", program, str(self.good), str(out), str(seconds)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            self.faults.append(f"memory: {done.stderr[-300:]}")
            return "not measured"
        _, rounds, first, last = done.stdout.splitlines()[-1].split()
        if float(last) - float(first) > MOST_GROWTH:
            self.faults.append(f"memory grew from {first} to {last} MiB in {rounds} rounds")
        return f"{float(first):.0f} MiB after three rounds, {float(last):.0f} MiB after {rounds}"

    @staticmethod
    def _digests(folder: Path) -> dict[str, str]:
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}

    @staticmethod
    def _require(holds: bool, problem: str) -> None:
        if not holds:
            raise AssertionError(problem)


def main() -> None:
    """Soak, print the report and keep it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--report", type=Path)
    asked = parser.parse_args()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), asked.seed)
        while time.monotonic() - started < 0.8 * asked.seconds:
            soak.round()
            print(f"{sum(soak.rounds.values())} rounds, {len(soak.faults)} faults", file=sys.stderr, flush=True)
        memory = soak.memory(0.2 * asked.seconds)
    lines = [
        f"{sum(soak.rounds.values())} rounds in {time.monotonic() - started:.0f} s, seed {asked.seed}",
        f"memory of one process: {memory}",
        *(f"- {name}: {count}" for name, count in sorted(soak.rounds.items())),
        f"faults: {len(soak.faults)}",
        *(f"- {fault}" for fault in soak.faults),
    ]
    print("\n".join(lines))
    if asked.report is not None:
        asked.report.write_text("# Soak\n\n" + "\n".join(lines) + "\n", encoding="utf-8")
    sys.exit(bool(soak.faults))


if __name__ == "__main__":
    main()
