"""What a forked process does while this one goes on computing: pictures, and shares of other work."""

from __future__ import annotations

import gc
import io
import multiprocessing
import os
import pickle
import shutil
import signal
import warnings
from collections.abc import Callable, Sequence
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

    Without another process, see :func:`forked`, the pictures are drawn when they are asked for.

    Raises (when they are asked for):
        Exception: what ``draw`` raised.
    """
    if comm.rank != 0:
        return list
    folder = TemporaryDirectory(prefix="softgrasp-")
    begun = forked(comm, partial(draw, Path(folder.name)))
    if begun is None:
        folder.cleanup()
        return partial(draw, out)

    def files() -> list[Path]:
        try:
            done = begun()
        except OSError:  # perhaps there is room in the folder itself
            return draw(out)
        out.mkdir(parents=True, exist_ok=True)
        with folder:
            note(*(out / file.name for file in done))
            return [Path(shutil.move(file, out / file.name)) for file in done]

    return files


def forked[T](comm: MPI.Intracomm, call: Callable[[], T], same: Sequence[object] = ()) -> Callable[[], T] | None:
    """Begin a call in a forked process; the function returned waits for the result. Not collective.

    The process has everything that is here by fork, and only the result is packed, but for the objects of ``same`` in
    it, which come back as those of this process. None where the caller has to call: on several ranks, which have the
    cores taken, and whose network may not survive a fork, on one core and where no process can be started.

    Raises (when the result is asked for):
        OSError: the process was lost, or stood still: a fork copies a lock that a thread of the network has, and not
            the thread that frees it.
        Exception: what ``call`` raised.
    """
    if comm.size > 1 or len(os.sched_getaffinity(0)) < 2:
        return None
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, call, same), daemon=True)
    try:
        with warnings.catch_warnings():  # of threads that hold locks: the child takes none of theirs
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return None
    sender.close()

    def result() -> T:
        done: Any
        try:
            done = _unpacked(receiver.recv_bytes(), same) if _comes(receiver, process.pid) else OSError("stood still")
        except EOFError:  # killed, for want of memory
            done = OSError("killed")
        if isinstance(done, OSError):
            process.kill()
        process.join()
        if isinstance(done, Exception):
            raise done
        found: T = done
        return found

    return result


def _comes(receiver: Connection, pid: int | None) -> bool:
    """Wait for an answer while the process computes; False once it stands still."""
    spent = -1.0
    while not receiver.poll(PATIENCE):
        now = sum(psutil.Process(pid).cpu_times()[:2])
        if now - spent < 0.01:
            return False
        spent = now
    return True


def _send(sender: Connection, call: Callable[[], Any], same: Sequence[object]) -> None:
    """Call in the child, and send the result or the error; Ctrl-C ends it at once."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    gc.disable()  # what belongs to PETSc and MPI is not this process's to free
    try:
        packed = _packed(call(), same)
    except Exception as error:
        packed = _packed(error, ())
    sender.send_bytes(packed)


def _packed(result: object, same: Sequence[object]) -> bytes:
    places = {id(each): i for i, each in enumerate(same)}

    class Packer(pickle.Pickler):
        def persistent_id(self, obj: object) -> int | None:
            return places.get(id(obj))

    file = io.BytesIO()
    Packer(file, pickle.HIGHEST_PROTOCOL).dump(result)
    return file.getvalue()


def _unpacked(packed: bytes, same: Sequence[object]) -> Any:
    class Unpacker(pickle.Unpickler):
        def persistent_load(self, pid: Any) -> object:
            return same[pid]

    return Unpacker(io.BytesIO(packed)).load()
