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
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import psutil
from mpi4py import MPI

from softgrasp.fem import note

Draw = Callable[[Path], list[Path]]
type Call[T] = Callable[[Callable[[], None]], T]
PATIENCE = 20.0  # [s] without any processor time, after which the other process is given up
PAUSED = b""  # message of a call that pauses, and the answer that lets it go on


def draw_in_background(comm: MPI.Intracomm, out: Path, draw: Draw) -> Callable[[], list[Path]]:
    """Begin to draw into ``out``; the function returned waits for the files and names them on rank 0. Not collective.

    Without another process, see :func:`forked`, the pictures are drawn when they are asked for.

    Raises (when they are asked for):
        Exception: what ``draw`` raised.
    """
    if comm.rank != 0:
        return list
    folder = TemporaryDirectory(prefix="softgrasp-")
    begun = forked(lambda pause: draw(Path(folder.name)))
    if begun is None:
        folder.cleanup()
        return partial(draw, out)

    def files() -> list[Path]:
        try:
            done = begun.result()
        except OSError:  # perhaps there is room in the folder itself
            return draw(out)
        out.mkdir(parents=True, exist_ok=True)
        with folder:
            note(*(out / file.name for file in done))
            return [Path(shutil.move(file, out / file.name)) for file in done]

    return files


@dataclass
class Forked[T]:
    """A call that a forked process works at; as a context it ends the process where it is left early.

    Methods raise (:class:`OSError`) when the process was lost, or stood still: a fork copies a lock that a thread of
    the network has, and not the thread that frees it. They raise what the call raised, too.
    """

    process: ForkProcess  # the other one
    pipe: Connection  # to it
    same: Sequence[object]  # objects that come back as those of this process
    _answer: bytes = b""  # the packed result, once it is there

    def wait(self) -> None:
        """Wait until the call pauses, or has its result."""
        try:
            answer = self.pipe.recv_bytes() if _comes(self.pipe, self.process.pid) else None
        except (EOFError, ConnectionResetError):  # killed, for want of memory
            answer = None
        if answer is None:
            self.end()
            raise OSError("the other process was lost")
        self._answer = answer

    def result(self) -> T:
        """Let the call go on, and wait for its result."""
        if not self._answer:
            with suppress(BrokenPipeError):  # it is lost, which the answer shows
                self.pipe.send_bytes(PAUSED)
            self.wait()
        done: Any = _unpacked(self._answer, self.same)
        self.process.join()
        if isinstance(done, OSError):
            raise OSError("the other process could not write") from done
        if isinstance(done, Exception):
            raise done
        found: T = done
        return found

    def end(self) -> None:
        """End the process whatever it does."""
        self.process.kill()
        self.process.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()


def forked[T](call: Call[T], same: Sequence[object] = ()) -> Forked[T] | None:
    """Begin a call in a forked process. Not collective.

    The process has everything that is here by fork, and only the result is packed, but for the objects of ``same`` in
    it, which come back as those of this process. None where the caller has to call: on several ranks, which have the
    cores taken, and whose network may not survive a fork, on one core and where no process can be started.

    Args:
        call: gets a function that pauses until this process asks for the result, so that either is timed alone.
        same: objects that need not or cannot be packed.
    """
    if MPI.COMM_WORLD.size > 1 or len(os.sched_getaffinity(0)) < 2:
        return None
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_send, args=(here, there, call, same), daemon=True)
    try:
        with warnings.catch_warnings():  # of threads that hold locks: the child takes none of theirs
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return None
    there.close()
    return Forked(process, here, same)


def _comes(pipe: Connection, pid: int | None) -> bool:
    """Wait for an answer while the process computes; False once it stands still."""
    spent = -1.0
    while not pipe.poll(PATIENCE):
        now = sum(psutil.Process(pid).cpu_times()[:2])
        if now - spent < 0.01:
            return False
        spent = now
    return True


def _send(
    here: Connection, there: Connection, call: Callable[[Callable[[], None]], Any], same: Sequence[object]
) -> None:
    """Call in the child, and send the result or the error; Ctrl-C ends it at once."""
    here.close()  # so that the end of the other process is seen
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    gc.disable()  # what belongs to PETSc and MPI is not this process's to free

    def pause() -> None:
        there.send_bytes(PAUSED)
        there.recv_bytes()

    try:
        packed = _packed(call(pause), same)
    except (EOFError, BrokenPipeError):  # nobody waits
        return
    except Exception as error:
        packed = _packed(error, ())
    there.send_bytes(packed)


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
