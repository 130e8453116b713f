"""Interruptible runs: Ctrl-C, and the command that resumes."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from noiseflow.commands.console import START_AGAIN, end_stopped, invocation

if TYPE_CHECKING:
    from recon.joint.checkpoint import Journal


class StopSignal:
    """Within the ``with`` block, Ctrl-C or SIGTERM stops a run: once after the current step, twice immediately."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal

    def __enter__(self) -> StopSignal:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        journal = self._journal
        if journal.stop_requested or not journal.in_fit:
            journal.abandoned = True
            raise KeyboardInterrupt
        journal.stop_requested = True
        with contextlib.suppress(OSError, ValueError, AttributeError):
            # bypasses the buffer, which the interrupted code may be writing to
            os.write(sys.stderr.fileno(), b"noiseflow: finishing this step; press Ctrl-C again to stop immediately\n")


@contextlib.contextmanager
def stoppable(journal: Journal) -> Iterator[None]:
    """Run interruptible fits. An interrupted run prints how to resume and exits with code 130. Raises SystemExit if the run was
    interrupted, and OSError if the disk is full or not available; the message says how to resume if there is a saved state.
    """
    try:  # also covers the signal handlers: a second Ctrl-C may arrive while they are restored
        with StopSignal(journal):
            try:
                yield
            except OSError as error:
                if journal.abandoned:  # a file was being closed when the interrupt came
                    raise KeyboardInterrupt from None
                if journal.resumed and journal.exists:
                    error.add_note(f"the last state is kept: after fixing this, resume with: {resume_command()}")
                raise
    except KeyboardInterrupt as stop:
        advice = f"resume with: {resume_command()}" if journal.resumed else START_AGAIN
        end_stopped(f"{str(stop) or ('stopped immediately' if journal.abandoned else 'stopped')}; {advice}")


def resume_command() -> str:
    """The command line that resumes the current command."""
    called = invocation()
    words = () if called is None else called.words
    return shlex.join(["noiseflow", *(word for word in words if word != "--resume"), "--resume"])
