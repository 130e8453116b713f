"""Console output that never raises: a closed terminal or pipe, or a limited encoding, must not affect the saved files."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any


class SteadyStream:
    """A text stream whose writes never raise. Text that cannot be written is dropped.

    Args:
        stream: the underlying stream, or None.

    Attributes:
        error: the error that caused text to be dropped, or None.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115
        self.error: Exception | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text; characters that the encoding lacks are escaped."""
        if self.error is None:
            try:
                self._write(text)
            except (OSError, ValueError) as error:
                self._drop(error)
        return len(text)

    def flush(self) -> None:
        """Flush the underlying stream."""
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
        with contextlib.suppress(OSError, ValueError, AttributeError):  # Python flushes once more at exit
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextlib.contextmanager
def steady_streams() -> Iterator[SteadyStream]:
    """Replace ``sys.stdout`` and ``sys.stderr`` within the block by streams that never raise; yield the former."""
    _open_standard_files()
    before = sys.stdout, sys.stderr
    out, err = (SteadyStream(stream) for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        yield out
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def was_lost(stream: SteadyStream) -> str | None:
    """Message about lost output, or None. A closed pipe is not reported, because its reader wanted no more."""
    error = stream.error
    if (
        error is None
        or isinstance(error, BrokenPipeError)
        or (isinstance(error, OSError) and error.errno == errno.EPIPE)
    ):
        return None
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return f"console output was lost ({reason.lower()}); all files are written"


def _open_standard_files() -> None:
    """Open closed standard streams to the null device; otherwise the next output file would get their descriptor."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
