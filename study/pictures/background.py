"""Pictures drawn by a forked process while this one goes on computing."""

from __future__ import annotations

import gc
import multiprocessing
import os
import shutil
import signal
import warnings
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil
from mpi4py import MPI

from softgrasp.fem import note

Draw = Callable[[Path], list[Path]]
PATIENCE = 20.0  # [s] without any processor time, after which the other process is given up


def draw_in_background(comm: MPI.Intracomm, out: Path, draw: Draw) -> Callable[[], list[Path]]:
    """Begin to draw into ``out``; the function returned waits for the files and names them on rank 0. Not collective.

    What is drawn must be on this rank already: the process has all of it by fork, nothing is copied or packed, and only
    the names come back. Several ranks have the cores taken, and their network may not survive a fork: with them, on
    one core and where no process can be started, the pictures are drawn when they are asked for. So are those of a
    process that stands still: a fork copies a lock that a thread of the network has, and not the thread that frees it.

    Raises (when they are asked for):
        Exception: what ``draw`` raised.
    """
    if comm.rank != 0:
        return list
    if comm.size > 1 or len(os.sched_getaffinity(0)) < 2:
        return partial(draw, out)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    folder = TemporaryDirectory(prefix="softgrasp-")
    process = context.Process(target=_send, args=(sender, draw, Path(folder.name)), daemon=True)
    try:
        with warnings.catch_warnings():  # of threads that hold locks: the child takes none of theirs
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return partial(draw, out)
    sender.close()

    def files() -> list[Path]:
        try:
            done = receiver.recv() if _comes(receiver, process.pid) else OSError()
        except EOFError:  # killed, for want of memory
            done = OSError()
        if isinstance(done, OSError):
            process.kill()
        process.join()
        if isinstance(done, OSError):  # perhaps there is room in the folder itself
            return draw(out)
        if isinstance(done, Exception):
            raise done
        out.mkdir(parents=True, exist_ok=True)
        with folder:
            note(*(out / file.name for file in done))
            return [Path(shutil.move(file, out / file.name)) for file in done]

    return files


def _comes(receiver: Connection, pid: int | None) -> bool:
    """Wait for an answer while the process computes; False once it stands still."""
    spent = -1.0
    while not receiver.poll(PATIENCE):
        now = sum(psutil.Process(pid).cpu_times()[:2])
        if now - spent < 0.01:
            return False
        spent = now
    return True


def _send(sender: Any, draw: Draw, folder: Path) -> None:
    """Draw in the child, and send the names or the error; Ctrl-C ends it at once."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    gc.disable()  # what belongs to PETSc and MPI is not this process's to free
    try:
        sender.send(draw(folder))
    except Exception as error:
        sender.send(error)
