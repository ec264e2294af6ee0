"""Ctrl-C during a run or a study, and SIGTERM, by which a cluster ends a job."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interruptible(speaks: bool = False) -> Iterator[list[bool]]:
    """Turn the first Ctrl-C or SIGTERM into an entry of the list; a second one ends the program at once.

    ``speaks``: report the first one on the standard error.
    """
    flag: list[bool] = []

    def stop(number: int, frame: Any) -> None:
        flag.append(True)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if speaks:
            with suppress(OSError):  # nobody listens; print may not be called while another print is under way
                os.write(2, b"\nstopping as soon as the restart file is written; a second signal stops at once\n")

    try:
        previous = {number: signal.signal(number, stop) for number in SIGNALS}
    except ValueError:  # not the main thread: leave signals alone
        yield flag
        return
    try:
        yield flag
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not one of Python's
