"""Console output that cannot fail: a closed terminal, a reader that has gone or a narrow encoding never decides what is saved."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any


class SteadyStream:
    """A text stream whose writes never raise; what can no longer be shown is dropped.

    Args:
        stream: where text goes; None where there is none.

    Attributes:
        error: why text was dropped, or None.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115
        self.error: Exception | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text; letters that the encoding does not have are escaped."""
        if self.error is None:
            try:
                self._write(text)
            except (OSError, ValueError) as error:
                self._drop(error)
        return len(text)

    def flush(self) -> None:
        """Pass on what is buffered."""
        if self.error is None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._drop(error)

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
        except UnicodeEncodeError as error:
            self._stream.write(text.encode(error.encoding, "backslashreplace").decode(error.encoding))

    def _drop(self, error: Exception) -> None:
        self.error = error
        with contextlib.suppress(OSError, ValueError, AttributeError):  # Python flushes once more at its end
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextlib.contextmanager
def steady_streams() -> Iterator[SteadyStream]:
    """Within the block, ``sys.stdout`` and ``sys.stderr`` never raise; yields the former."""
    _open_standard_files()
    before = sys.stdout, sys.stderr
    out, err = (SteadyStream(stream) for stream in before)
    sys.stdout, sys.stderr = out, err  # type: ignore[assignment]
    try:
        yield out
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def was_lost(stream: SteadyStream) -> str | None:
    """Why output was lost that somebody waits for, or None; a reader that closed its pipe wanted no more."""
    error = stream.error
    if (
        error is None
        or isinstance(error, BrokenPipeError)
        or (isinstance(error, OSError) and error.errno == errno.EPIPE)
    ):
        return None
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return f"what was printed is lost ({reason.lower()}); all files are written"


def _open_standard_files() -> None:
    """Open closed standard files to nowhere: the next output file would take their number, and be printed into."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
