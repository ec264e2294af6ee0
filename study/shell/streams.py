"""Standard streams whose reader may leave."""

from __future__ import annotations

import contextlib
import io
import locale
import signal
import sys
from typing import Any


class Unread(io.FileIO):
    """A standard stream; what is written after its reader has gone goes nowhere."""

    def write(self, data: Any, /) -> int:
        """Write, or drop what nobody reads."""
        try:
            return super().write(data) or 0
        except BrokenPipeError:
            return len(memoryview(data))


def write_utf8() -> None:
    """Let files be read and written as UTF-8 in any locale, as scenes and JSON are."""
    if locale.getencoding().lower() != "utf-8":
        with contextlib.suppress(locale.Error):  # no such locale here: names beyond ASCII then end in a sentence
            locale.setlocale(locale.LC_CTYPE, "C.UTF-8")


def outlive_readers() -> None:
    """Let the program run on when the reader of its output ends. Not collective: call on every rank, in main only.

    Under mpiexec the launcher reads the output, and ends all ranks when its own reader goes.
    """
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # a PETSc that is initialised already aborts on it
    for name in ("stdout", "stderr"):
        given = getattr(sys, name)
        if isinstance(given, io.TextIOWrapper):
            given.flush()
            raw = Unread(given.fileno(), "w", closefd=False)
            buffer: Any = raw if isinstance(given.buffer, io.RawIOBase) else io.BufferedWriter(raw)
            how: dict[str, Any] = {"line_buffering": given.line_buffering, "write_through": given.write_through}
            setattr(sys, name, io.TextIOWrapper(buffer, given.encoding, "backslashreplace", **how))
