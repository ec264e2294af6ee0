"""Ctrl-C during a run or a study."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def interruptible(speaks: bool = False) -> Iterator[list[bool]]:
    """Turn the first Ctrl-C into an entry of the list; a second one interrupts at once.

    ``speaks``: say on the standard error that the first one was seen.
    """
    flag: list[bool] = []

    def stop(number: int, frame: Any) -> None:
        flag.append(True)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if speaks:
            with suppress(OSError):  # nobody listens; print may not be called while another print is under way
                os.write(2, b"\nstopping as soon as the restart file is written; Ctrl-C again stops at once\n")

    try:
        previous = signal.signal(signal.SIGINT, stop)
    except ValueError:  # not the main thread: leave signals alone
        yield flag
        return
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, previous)
