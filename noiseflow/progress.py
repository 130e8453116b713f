"""Progress of long computations: one signature for all, shown as a bar on a terminal and as lines in a log."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar

from noiseflow.described import printable

Progress = Callable[[str, int, int, str], None]
"""``progress(task, done, total, note)`` after each step: the task, its completed and expected steps, and a short note."""
# Between lines of a log.
_LOG_SECONDS = 10.0
_SHOWN: ContextVar[bool] = ContextVar("shown", default=False)


@contextlib.contextmanager
def in_json_mode_too() -> Iterator[None]:
    """Show progress in JSON mode too, for commands that another command runs for their JSON result."""
    token = _SHOWN.set(True)
    try:
        yield
    finally:
        _SHOWN.reset(token)


@contextlib.contextmanager
def progress_shown(*, json_mode: bool = False) -> Iterator[Progress]:
    """Progress with rate and remaining time: a bar on a terminal, occasional lines in a log, nothing in JSON mode."""
    if json_mode and not _SHOWN.get():
        yield lambda task, done, total, note: None
    elif not sys.stderr.isatty():
        yield _LogLines()
    else:
        yield from _bars()


class _Rate:
    """Steps per second in the last half of the current task's time; a new title or a smaller count starts a new measurement."""

    title, seen = "", list[tuple[float, int]]()

    def __call__(self, title: str, done: int) -> float:
        now = time.monotonic()
        if title != self.title or done < self.seen[-1][1]:
            self.title, self.started, self.seen = title, now, []
        self.seen.append((now, done))
        while len(self.seen) > 2 and self.seen[1][0] <= (self.started + now) / 2:
            del self.seen[0]
        return (done - self.seen[0][1]) / max(now - self.seen[0][0], 1e-30)


class _LogLines:
    def __init__(self) -> None:
        self.rate, self.last = _Rate(), time.monotonic()

    def __call__(self, title: str, done: int, total: int, note: str) -> None:
        rate, now = self.rate(title, done), time.monotonic()
        if now - self.last >= _LOG_SECONDS and rate > 0:
            self.last = now
            speed = f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"
            seconds = (total - done) / rate
            longer = f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
            left = f"{seconds:.0f} s" if seconds < 120 else longer
            line = f"{title}: {done}/{total}, {speed} steps/s, {left} left, {note}"
            print(printable(line), file=sys.stderr, flush=True)


def _bars() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    more = (TextColumn("{task.fields[rate]:.1f}/s"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"))
    with RichProgress(*columns, *more, console=Console(stderr=True)) as bars:
        task, measure = bars.add_task("", total=None, rate=0.0, note="", visible=False), _Rate()

        def report(title: str, done: int, total: int, note: str) -> None:
            if title != measure.title:
                bars.reset(task, total=total, description=title, visible=True)
            bars.update(task, completed=done, rate=measure(title, done), note=note)

        yield report
