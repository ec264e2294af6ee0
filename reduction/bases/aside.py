"""Bases of several methods made at the same time by threads of a program of one rank.

PETSc serves one thread at a time, so all but one wait for their turn. LAPACK needs no turn: a thread gives its own away
while it is in there.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from mpi4py import MPI

MOST = 4  # threads: each holds a factored copy of the snapshots

_turn = threading.Lock()
_mine = threading.local()


@contextmanager
def aside() -> Iterator[None]:
    """A block of LAPACK alone, with NumPy's wrappers, which do not hold Python's lock: other threads work meanwhile."""
    has_turn = getattr(_mine, "turn", False)
    if has_turn:
        _turn.release()
    try:
        yield
    finally:
        if has_turn:
            _turn.acquire()


def in_threads[R](tasks: Sequence[Callable[[], R]]) -> list[R]:
    """Results of the tasks, worked at by a thread for each core, :data:`MOST` at most. On communicators of one rank.

    Raises Exception: that of the first task that fails.
    """

    def work(task: Callable[[], R]) -> R:
        with _turn:
            _mine.turn = True
            try:
                return task()
            finally:
                _mine.turn = False

    with ThreadPoolExecutor(min(cores(), MOST)) as pool:
        return list(pool.map(work, tasks))


def cores() -> int:
    """Cores that this process may use; 1 where MPI does not allow calls from several threads."""
    if MPI.Query_thread() < MPI.THREAD_SERIALIZED:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
