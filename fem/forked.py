"""A share of work that a forked process does while this one computes."""

from __future__ import annotations

import gc
import io
import multiprocessing
import os
import pickle
import signal
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any, Literal, Self

import psutil
from mpi4py import MPI

from softgrasp.fem.resources import cores

Pause = Callable[[Any], Any]
"""Called by the other process with what :meth:`Forked.wait` returns; returns what :meth:`Forked.go_on` is given."""
PATIENCE = 20.0  # [s] without any processor time, after which the other process is given up


@dataclass
class Forked[T]:
    """A call that a forked process works at; as a context it ends the process where it is left.

    Methods raise OSError when the process was lost, or stood still: a fork copies a lock that a thread of the network
    has, and not the thread that frees it. They raise what the call raised, too.
    """

    process: ForkProcess  # the other one
    pipe: Connection  # to it
    same: Sequence[object]  # objects that come back as those of this process
    state: Literal["running", "paused", "done"] = "running"  # of the call, as far as this process knows
    _value: Any = None  # what the call paused with, or its result

    def wait(self) -> Any:
        """Wait until the call pauses, or has its result; what it paused with."""
        try:
            answer = self.pipe.recv_bytes() if _comes(self.pipe, self.process.pid) else None
        except (EOFError, ConnectionResetError):  # killed, for want of memory
            answer = None
        if answer is None:
            self.end()
            raise OSError("the other process was lost")
        kind, self._value = unpacked(answer, self.same)
        if kind == "raised":
            self.end()
            raise self._value
        self.state = kind
        return self._value

    def go_on(self, request: object = None) -> None:
        """Let a call that paused go on, with what its pause is to return."""
        with suppress(BrokenPipeError):  # it is lost, which the answer shows
            self.pipe.send(request)
        self.state = "running"

    def result(self) -> T:
        """Let the call go on where it paused, and wait for its result."""
        if self.state == "paused":
            self.go_on()
        if self.state == "running":
            self.wait()
        self.process.join()
        found: T = self._value
        return found

    def end(self) -> None:
        """End the process whatever it does."""
        self.process.kill()
        self.process.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()


def forked[T](call: Callable[[Pause], T], same: Sequence[object] = ()) -> Forked[T] | None:
    """Begin a call in a forked process. Not collective.

    The process has everything that is here by fork, and only the result is packed, but for the objects of ``same`` in
    it, which come back as those of this process. None where the caller has to call: on several ranks, which have the
    cores taken, and whose network may not survive a fork, on one core and where no process can be started.

    Args:
        call: gets a function that pauses until this process lets it go on.
        same: objects that need not or cannot be packed.
    """
    if MPI.COMM_WORLD.size > 1 or cores() < 2:
        return None
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(here, there, call, same), daemon=True)
    try:
        with warnings.catch_warnings():  # of threads that hold locks: the child takes none of theirs
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return None
    there.close()
    return Forked(process, here, same)


def shared[T](
    own: Sequence[Callable[[], T]], beside: Sequence[Callable[[], T]], same: Sequence[object] = ()
) -> list[T]:
    """Results of the calls ``own``, then of ``beside``, which a forked process begins with. Not collective.

    Whoever is done with its calls goes on with those of the other from their end, so that both end at about the same
    time on whatever cores. Without another process, see :func:`forked`, or where it is lost, this one makes all; so it
    does where they are more than a pipe holds bytes.

    ``same``: objects in the results that need not or cannot be packed.

    Raises Exception: that of a call.
    """
    calls = [*own, *reversed(beside)]
    left, put = os.pipe()  # a byte for each call that nobody has begun; both take from opposite ends
    os.set_blocking(put, False)
    fits = os.write(put, bytes(len(calls))) == len(calls)  # 65 536 do on Linux
    os.close(put)

    def made(order: Iterable[int]) -> dict[int, T]:
        return {i: calls[i]() for i in order if os.read(left, 1)}

    try:
        other = forked(lambda pause: made(reversed(range(len(calls)))), same) if fits and own and beside else None
        with other or nullcontext():
            found = made(range(len(calls)))
            if other is not None:
                with suppress(OSError):
                    found |= other.result()
    finally:
        os.close(left)
    every = [found[i] if i in found else call() for i, call in enumerate(calls)]
    return [*every[: len(own)], *reversed(every[len(own) :])]


def _comes(pipe: Connection, pid: int | None) -> bool:
    """Wait for an answer while the process computes; False once it stands still."""
    spent = -1.0
    while not pipe.poll(PATIENCE):
        now = sum(psutil.Process(pid).cpu_times()[:2])
        if now - spent < 0.01:
            return False
        spent = now
    return True


def _work(here: Connection, there: Connection, call: Callable[[Pause], Any], same: Sequence[object]) -> None:
    """Call in the child, and send the result or the error; Ctrl-C ends it at once."""
    here.close()  # so that the end of the other process is seen
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    gc.disable()  # what belongs to PETSc and MPI is not this process's to free

    def pause(value: Any = None) -> Any:
        there.send_bytes(packed(("paused", value), same))
        return there.recv()

    try:
        answer = packed(("done", call(pause)), same)
    except (EOFError, BrokenPipeError):  # nobody waits
        return
    except Exception as error:
        answer = packed(("raised", error), ())
    there.send_bytes(answer)


def packed(result: object, same: Sequence[object]) -> bytes:
    """A result without the objects of ``same``, for another process."""
    places = {id(each): i for i, each in enumerate(same)}

    class Packer(pickle.Pickler):
        def persistent_id(self, obj: object) -> int | None:
            return places.get(id(obj))

    file = io.BytesIO()
    Packer(file, pickle.HIGHEST_PROTOCOL).dump(result)
    return file.getvalue()


def unpacked(sent: bytes, same: Sequence[object]) -> Any:
    """The result of :func:`packed`, with the objects of ``same`` of this process."""

    class Unpacker(pickle.Unpickler):
        def persistent_load(self, pid: Any) -> object:
            return same[pid]

    return Unpacker(io.BytesIO(sent)).load()
