"""Standard streams whose reader may leave, and Ctrl-C while modules load.

Imports nothing but the standard library, so that it can come first.
"""

from __future__ import annotations

import contextlib
import io
import locale
import os
import signal
import sys
from types import FrameType
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


def quiet_imports() -> None:
    """Let Ctrl-C end the program at once while modules load, where KeyboardInterrupt would tear compiled ones apart.

    Leaves any handler but Python's own alone.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    outer = frame
    while outer is not None:
        if outer.f_code.co_filename == "<frozen importlib._bootstrap>":
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        outer = outer.f_back
    signal.default_int_handler(number, frame)
