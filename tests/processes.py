"""Commands in processes of their own, so that they can be stopped; forked, for importing torch takes longer than they do."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing.context import ForkProcess
from pathlib import Path

import torch

from noiseflow import progress
from noiseflow.commands.cli import main

FORK = multiprocessing.get_context("fork")


def start(arguments: Sequence[object], log: Path) -> ForkProcess:
    """Start a command; all that it prints goes to a file, with a line for every step."""
    process = FORK.Process(target=_child, args=([str(argument) for argument in arguments], log))
    log.unlink(missing_ok=True)
    process.start()
    wait_for(log.exists, process)
    return process


def finish(arguments: Sequence[object], log: Path) -> str:
    """Run a command that must succeed; returns what it printed."""
    process = start(arguments, log)
    process.join(300)
    assert process.exitcode == 0, log.read_text()
    return log.read_text()


def wait_for(condition: Callable[[], bool], process: ForkProcess, seconds: float = 120) -> None:
    """Wait until the running command has come so far."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.is_alive(), "the command ended before it could be stopped"
        assert time.monotonic() < end, "the command never got there"
        time.sleep(0.005)


def _child(arguments: list[str], log: Path) -> None:
    os.setpgrp()
    torch.set_num_threads(1)
    progress._LOG_SECONDS = -1.0
    with log.open("w", buffering=1) as stream:
        sys.stdout = sys.stderr = stream
        sys.argv = ["noiseflow", *arguments]
        try:
            main()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
