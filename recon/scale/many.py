"""Many tilt series, each reconstructed by a process of its own: what one of them breaks, the others do not notice."""

from __future__ import annotations

import contextlib
import csv
import ctypes
import json
import os
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
from noiseflow.io.ownership import signature
from recon.scale.cluster import all_threads_of_worker, usable_cores

Row = dict[str, Any]
COLUMNS = ("series", "volume", "status", "verdict", "reason", "error", "seconds")
"""First columns of the table of results; the figures of `noiseflow reconstruct` follow."""
_NOT_OPTIONS = ("tilts", "out")
_PARENT_DEATH_SIGNAL = 1  # of prctl(2)
_OUTPUT = ("-o", "--out", "--output")
_JSON_START = '{\n "written_by": "noiseflow'


@dataclass(frozen=True)
class Job:
    """One series.

    Attributes:
        tilts: its stack.
        out: the volume to write.
        words: further words of the command ``noiseflow reconstruct``.
    """

    tilts: Path
    out: Path
    words: tuple[str, ...] = ()

    @property
    def command(self) -> list[str]:
        """What reconstructs it."""
        return ["reconstruct", str(self.tilts), "-o", str(self.out), *self.words]


def jobs_of(source: Path, out: Path, words: Sequence[str] = ()) -> list[Job]:
    """The series of a folder, or of a table.

    Args:
        source: a folder, of which every stack with tilt angles counts, or a CSV table with a column ``tilts``; a column ``out``
            names volumes, and others are options of ``noiseflow reconstruct``, as they are written, without the dashes.
        out: folder of the volumes that no table names.
        words: options of all series; those of a table come after them.

    Raises:
        FileNotFoundError: there is no such folder or table, or no series in it.
        ValueError: a table without the column, two series of the same volume, a volume that would replace another series or a
            file among its options, or an option that names the volume.
    """
    if source.is_dir():
        jobs = [
            Job(path, out / f"{path.stem}.mrc", tuple(words)) for path in sorted(source.iterdir()) if _is_series(path)
        ]
    elif source.is_file():
        jobs = [_job_of_row(row, source.parent, out, words) for row in _rows(source)]
    else:
        raise FileNotFoundError(f"{source} does not exist; give a folder of tilt series, or a CSV table of them")
    if not jobs:
        raise FileNotFoundError(f"{source} holds no stack with tilt angles, beside it or of its own")
    targets = [job.out for job in jobs]
    named = next((word for job in jobs for word in job.words if word.partition("=")[0] in _OUTPUT), None)
    if named is not None:
        raise ValueError(
            f"{named} among the options would be the volume of every series; name volumes in the column 'out'"
        )
    _require_apart(jobs)
    twice = next((target for target in targets if targets.count(target) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} would be the volume of two series; name them in a table with a column 'out'")
    return jobs


def _require_apart(jobs: Sequence[Job]) -> None:
    """Each series refuses itself as its volume; here it is another's, read before or after."""
    read: dict[tuple[int, int], Job] = {}
    for job in jobs:
        for path in (job.tilts, *map(Path, job.words)):
            with contextlib.suppress(OSError, ValueError):
                read.setdefault(_identity(path), job)
    for job in jobs:
        with contextlib.suppress(OSError):
            other = read.get(_identity(job.out))
            if other is not None and _identity(job.tilts) != _identity(job.out):
                raise ValueError(
                    f"{job.out} would be lost: it is read for {other.tilts}; name another volume for {job.tilts}"
                )


def _identity(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_dev, found.st_ino


def reconstruct_all(jobs: Sequence[Job], *, workers: int, client: Any = None) -> Iterator[Row]:
    """Rows of the table, as series are done.

    Args:
        jobs: the series.
        workers: processes at a time, which share the cores of this machine.
        client: a Dask client whose workers do it; they must see the files.
    """
    if client is not None:
        import dask.distributed

        library: Any = dask.distributed  # it has no types
        tasks = {client.submit(_on_worker, job, pure=False): job for job in jobs}
        for task in library.as_completed(list(tasks), loop=client.loop):
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
    """The rows of a table of results that `write_table` wrote; none where there is no such file."""
    if not path.is_file():
        return []
    if path.suffix.lower() == ".json":
        rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["series"]
        return rows
    return _rows(path)


def require_own_table(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a table that `write_table` did not write.

    Raises:
        FileExistsError: the file is another's.
    """
    if overwrite or not path.exists() or path.stat().st_size == 0:
        return
    with path.open("rb") as stream:
        head = stream.read(200)
    # CSV has no place for a mark: the columns are ours
    if not head.startswith((_JSON_START.encode(), ",".join(COLUMNS).encode()[:200])):
        raise FileExistsError(
            f"{path} exists and was not written by noiseflow; name another --table, or replace it with --overwrite"
        )


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows to a CSV or JSON file, all at once or not at all."""
    with io.atomic_path(path) as partial:
        if path.suffix.lower() == ".json":
            partial.write_text(
                json.dumps({"written_by": signature(), "series": list(rows)}, indent=1) + "\n",
                encoding="utf-8",
                newline="\n",
            )
            return
        names = list(dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)]))
        with partial.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, names)
            writer.writeheader()
            writer.writerows(rows)


def left_out(source: Path) -> list[str]:
    """Names of the images of a folder that are no series, since no tilt angles lie beside them or in them."""
    if not source.is_dir():
        return []
    return [path.name for path in sorted(source.iterdir()) if path.suffix.lower() in SUFFIXES and not _is_series(path)]


def _is_series(path: Path) -> bool:
    """Whether a file is a stack whose angles are known: they lie beside it, or in it."""
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
        raise ValueError(
            f"{path} is no CSV table ({error}); give a folder of tilt series, or a table of them"
        ) from error


def _job_of_row(row: Row, folder: Path, out: Path, words: Sequence[str]) -> Job:
    if not row.get("tilts"):
        raise ValueError(f"the table needs a column 'tilts' with a file in every row; found {', '.join(map(str, row))}")
    tilts = folder / row["tilts"]
    more = [
        word
        for name, value in row.items()
        if name not in _NOT_OPTIONS and value
        for word in ([f"--{name}"] if value.lower() == "yes" else [f"--{name}", value])
    ]
    return Job(tilts, folder / row["out"] if row.get("out") else out / f"{tilts.stem}.mrc", (*words, *more))


class _Running:
    """The processes that run now."""

    def __init__(self) -> None:
        self.lock, self.processes, self.stopped = Lock(), set[subprocess.Popen[bytes]](), False

    def stop(self) -> None:
        """End them, each of which saves its state first, and begin no other."""
        with self.lock:
            self.stopped = True
            for process in self.processes:
                process.terminate()


def _on_worker(job: Job) -> Row:
    with all_threads_of_worker() as threads:
        return _row(job, *_run(job.command, threads, _Running()))


def _run(words: Sequence[str], threads: int, running: _Running) -> tuple[Row | None, str]:
    """What a command answered, and the last line of what it printed; no answer where it failed."""
    command = [sys.executable, "-m", "noiseflow", *words, "--json"]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    with running.lock:
        if running.stopped:
            return None, "not begun"
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            env=environment,
            preexec_fn=_ending_with_this(),
        )
        running.processes.add(process)
    said, told = process.communicate()
    running.processes.discard(process)
    lines = [
        text for line in told.decode(errors="replace").splitlines() if (text := line.strip("│╭╮╰╯─ "))
    ]  # a box of usage
    last = lines[-1].removeprefix("noiseflow: ") if lines else ""
    if process.returncode:
        return None, last or f"exit {process.returncode}"
    return json.loads(said.decode().strip().splitlines()[-1]), last


def _ending_with_this() -> Callable[[], None] | None:
    """What lets a new process end, its state saved, when this one is killed; else it would hold its output from the next run.

    Only Linux tells processes that their parent has died. The library is loaded here, for a new process of a program with
    threads may do little before it starts.
    """
    if not sys.platform.startswith("linux"):
        return None
    tell = ctypes.CDLL(None).prctl
    return lambda: tell(_PARENT_DEATH_SIGNAL, int(signal.SIGTERM)) and None


def _row(job: Job, answer: Row | None, last: str) -> Row:
    row: Row = {"series": str(job.tilts), "volume": str(job.out)}
    if answer is None:
        return row | {"status": "failed", "error": last}
    verdict = answer["verdict"]
    row |= {"status": "done", "verdict": verdict["grade"], "reason": next(iter(verdict["reasons"]), ""), "error": ""}
    figures = {name: value for name, value in answer["figures"].items() if name != "seconds"}
    return row | {"seconds": round(answer["seconds"], 1)} | figures
