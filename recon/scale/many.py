"""Batches of tilt series, each reconstructed in a separate process, so that failures do not affect others."""

import contextlib
import csv
import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from noiseflow import io
from noiseflow.io.image_file import SUFFIXES
from noiseflow.runs.ownership import signature
from recon.scale.blocks import all_threads_of_worker, usable_cores

Row = dict[str, Any]
COLUMNS = ("series", "volume", "status", "verdict", "reason", "error", "options", "seconds")
"""First columns of the table of results, followed by the values of `noiseflow reconstruct`."""
_OUTPUT = ("-o", "--out", "--output")


@dataclass(frozen=True)
class Job:
    """One series to reconstruct.

    Attributes:
        words: further arguments of ``noiseflow reconstruct``.
    """

    tilts: Path
    out: Path
    words: tuple[str, ...] = ()

    @property
    def command(self) -> list[str]:
        """The command that reconstructs the series."""
        return ["reconstruct", str(self.tilts), "-o", str(self.out), *self.words]

    @property
    def options(self) -> str:
        """The options that determine the volume."""
        return shlex.join(word for word in self.words if word not in ("--resume", "--overwrite"))


def jobs_of(source: Path, out: Path, words: Sequence[str] = ()) -> list[Job]:
    """The series of a folder or of a table. Raises FileNotFoundError if the folder or table does not exist, or has no series;
    and ValueError if the table has no column ``tilts``, two series have the same volume, a volume would replace another series
    or an input file, or an option names the volume.

    Args:
        source: a folder, whose stacks with tilt angles are used, or a CSV table with a column ``tilts``. A column ``out`` names
            volumes; other columns are options of ``noiseflow reconstruct`` without the dashes.
        out: folder for volumes that the table does not name.
        words: options for all series; options in a table follow them.
    """
    if source.is_dir():
        stacks = filter(_is_series, sorted(source.iterdir()))
        jobs = [Job(path, out / f"{path.stem}.mrc", tuple(words)) for path in stacks]
    elif source.is_file():
        jobs = [_job_of_row(row, source.parent, out, words) for row in _rows(source)]
    else:
        raise FileNotFoundError(f"{source} does not exist; give a folder of tilt series, or a CSV table of them")
    if not jobs:
        raise FileNotFoundError(
            f"{source} holds no stack with tilt angles, in the stack or next to it; folders in it are not searched"
        )
    targets = [job.out for job in jobs]
    named = next((word for job in jobs for word in job.words if word.partition("=")[0] in _OUTPUT), None)
    if named is not None:
        raise ValueError(f"{named} in the options names one volume for all series; name them in a column 'out'")
    _require_apart(jobs)
    twice = next((target for target in targets if targets.count(target) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} would be the volume of two series; name them in a table with a column 'out'")
    return jobs


def _require_apart(jobs: Sequence[Job]) -> None:
    """Check that no volume replaces an input of another series; the command checks the inputs of its own series."""
    read: dict[tuple[int, int], Job] = {}
    for job in jobs:
        for path in (job.tilts, *map(Path, job.words)):
            with contextlib.suppress(OSError, ValueError):
                read.setdefault(_identity(path), job)
    for job in jobs:
        with contextlib.suppress(OSError):
            other = read.get(_identity(job.out))
            if other is not None and _identity(job.tilts) != _identity(job.out):
                raise ValueError(f"{job.out} is an input of {other.tilts}; name another volume for {job.tilts}")


def _identity(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_dev, found.st_ino


def reconstruct_all(jobs: Sequence[Job], *, workers: int, client: Any = None) -> Iterator[Row]:
    """Reconstruct all series, and yield the rows of the table as they finish.

    Args:
        workers: number of simultaneous processes, which share the cores of this machine.
        client: a Dask client whose workers reconstruct the series; they need access to the files.
    """
    if client is not None:
        import dask.distributed

        tasks = {client.submit(_on_worker, job, pure=False): job for job in jobs}
        for task in dask.distributed.as_completed(list(tasks), loop=client.loop):
            yield task.result() if task.status == "finished" else _row(tasks[task], None, str(task.exception()))
        return
    threads = max(1, usable_cores() // workers)
    running = _Running()
    with ThreadPoolExecutor(workers) as pool:
        of = {pool.submit(_run, job.command, threads, running): job for job in jobs}
        try:
            for future in as_completed(of):
                yield _row(of[future], *future.result())
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            running.stop()


def read_table(path: Path) -> list[Row]:
    """The rows of a table that `write_table` wrote; empty if the file does not exist."""
    if not path.is_file():
        return []
    if path.suffix.lower() == ".json":
        rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["series"]
        return rows
    return _rows(path)


def finished(rows: Sequence[Row], jobs: Sequence[Job]) -> list[Row]:
    """The rows of volumes that exist and, if they are still to be made, were made with the same options."""
    options = {str(job.out): job.options for job in jobs}
    done = (row for row in rows if row["status"] == "done" and Path(row["volume"]).exists())
    return [row for row in done if options.get(row["volume"], row.get("options")) == row.get("options")]


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows to a CSV or JSON file, atomically."""
    with io.atomic_path(path) as partial:
        if path.suffix.lower() == ".json":
            content = json.dumps({"written_by": signature(), "series": list(rows)}, indent=1) + "\n"
            partial.write_text(content, encoding="utf-8", newline="\n")
            return
        names = list(dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)]))
        with partial.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, names)
            writer.writeheader()
            writer.writerows(rows)


def left_out(source: Path) -> list[str]:
    """Names of images in a folder that are skipped, because they have no tilt angles, and of folders of images in it."""
    inside = sorted(source.iterdir()) if source.is_dir() else []
    files = [path.name for path in inside if path.suffix.lower() in SUFFIXES and not _is_series(path)]
    folders = (path for path in inside if path.is_dir() and path.name not in files and not _is_series(path))
    return files + [f"{path.name}/" for path in folders if any(f.suffix.lower() in SUFFIXES for f in path.iterdir())]


def _is_series(path: Path) -> bool:
    """Whether a file is a stack with tilt angles, in the file or next to it."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    if io.angle_file_of(path) is not None:
        return True
    try:
        return io.read(path, mapped=True).tilt_angles is not None
    except (ValueError, ImportError):
        return False


def _rows(path: Path) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            return list(csv.DictReader(stream))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV table ({error}); give a folder or a CSV table of tilt series") from error


def _job_of_row(row: Row, folder: Path, out: Path, words: Sequence[str]) -> Job:
    if not row.get("tilts"):
        raise ValueError(f"the table needs a column 'tilts' with a file in every row; found {', '.join(map(str, row))}")
    tilts = folder / row["tilts"]
    given = {name: value for name, value in row.items() if value and name not in ("tilts", "out")}
    more = [word for name, value in given.items() for word in (f"--{name}", value) if word.lower() != "yes"]
    return Job(tilts, folder / row["out"] if row.get("out") else out / f"{tilts.stem}.mrc", (*words, *more))


class _Running:
    def __init__(self) -> None:
        self.lock, self.processes, self.stopped = Lock(), set[subprocess.Popen[bytes]](), False

    def stop(self) -> None:
        """Stop all processes, which save their states first, and start no others."""
        with self.lock:
            self.stopped = True
            for process in self.processes:
                process.terminate()


def _on_worker(job: Job) -> Row:
    with all_threads_of_worker() as threads:
        return _row(job, *_run(job.command, threads, _Running()))


def _run(words: Sequence[str], threads: int, running: _Running) -> tuple[Row | None, str]:
    """The result of a command (None if it failed), and the last line of its output."""
    command = [sys.executable, "-m", "noiseflow", *words, "--json"]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    with running.lock:
        if running.stopped:
            return None, "not begun"
        streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
        process = subprocess.Popen(command, env=environment, preexec_fn=_ending_with_this(), **streams)
        running.processes.add(process)
    said, told = process.communicate()
    running.processes.discard(process)
    # lines of the frame around usage errors
    lines = [text for line in told.decode(errors="replace").splitlines() if (text := line.strip("│╭╮╰╯─ "))]
    last = lines[-1].removeprefix("noiseflow: ") if lines else ""
    if process.returncode:
        return None, last or f"exit {process.returncode}"
    return json.loads(said.decode().strip().splitlines()[-1]), last


def _ending_with_this() -> Callable[[], None] | None:
    """A function for new processes that ends them, with saved state, when this process is killed; otherwise they would keep the
    lock of their output.

    Only Linux can notify processes that their parent has died. The library is loaded here, because a forked process of a program
    with threads may do little before it executes another program.
    """
    if not sys.platform.startswith("linux"):
        return None
    tell = ctypes.CDLL(None).prctl
    return lambda: tell(1, int(signal.SIGTERM)) and None  # 1 is PR_SET_PDEATHSIG


def _row(job: Job, answer: Row | None, last: str) -> Row:
    row: Row = {"series": str(job.tilts), "volume": str(job.out), "options": job.options}
    if answer is None:
        return row | {"status": "failed", "error": last}
    verdict = answer["verdict"]
    row |= {"status": "done", "verdict": verdict["grade"], "reason": next(iter(verdict["reasons"]), ""), "error": ""}
    figures = {name: value for name, value in answer["figures"].items() if name != "seconds"}
    return row | {"seconds": round(answer["seconds"], 1)} | figures
