"""Errors for users, raised on all ranks or on none.

Every message is one sentence that names the file, key or value and what would be right.
"""

from __future__ import annotations

import errno
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # scenes are read without MPI
    from mpi4py import MPI

SPIN = 1e-3  # time that a rank waits awake before it sleeps [s]
NAP = 0.02  # longest sleep between two looks at the other ranks [s]
SHARE = 0.1  # of the time waited so far that a sleep takes, so that a rank is late by a tenth of its wait at most
LONGEST = 590  # letters of the longest sentence, some lines of a terminal [1]


def one_line(text: str) -> str:
    """Text fit for one line of any terminal: control characters escaped, the middle left out beyond `LONGEST`."""
    if len(text) > LONGEST:
        half = (LONGEST - 5) // 2
        text = f"{text[:half]} ... {text[-half:]}"
    shown = "".join(c if c.isprintable() or c == "\u00a0" else ascii(c)[1:-1] for c in text)
    return shown if len(shown) <= LONGEST else one_line(shown)


def no_pipe(path: Path) -> Path:
    """A file to be read, which a pipe is not: opening one waits for its writer, perhaps for ever.

    Raises OSError: it is one.
    """
    if stat.S_ISFIFO(path.stat().st_mode):
        raise OSError(errno.ESPIPE, "it is a pipe; write it to a file first", str(path))
    return path


def shortened(value: str) -> str:
    """A value shortened for a sentence, to at most 60 letters."""
    return value if len(value) <= 60 else value[:57] + "..."


class SoftgraspError(Exception):
    """Base of all errors that end a command with one sentence and a non-zero status."""

    def __str__(self) -> str:
        return one_line(super().__str__())

    def __reduce__(self) -> tuple[Any, ...]:
        """For another rank or process: a subclass whose call takes more than a text is made without it."""
        return _again, (type(self), self.args, self.__dict__)


def _again(kind: type[SoftgraspError], args: tuple[Any, ...], facts: dict[str, Any]) -> SoftgraspError:
    """The error with these arguments and attributes."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(facts)
    return error


class SoftgraspWarning(RuntimeWarning):
    """What a user should know and no result carries, one sentence; commands write it without file and line."""


class SceneError(SoftgraspError):
    """A scene key is missing, unknown, ill-typed or physically meaningless."""


class MeshError(SoftgraspError):
    """A mesh cannot be read, or is not fit for the model."""


class SolverError(SoftgraspError):
    """A solve failed or missed its tolerance."""


class ResourceError(SoftgraspError):
    """The run would not fit in memory or on disk."""


class CheckpointError(SoftgraspError):
    """A restart file is missing, damaged or belongs to another run."""


class Interrupted(SoftgraspError):
    """The user stopped the run; the message names the restart file."""


class Paused(Interrupted):
    """A run has reached the step at which it was to pause."""


def meet(comm: MPI.Intracomm) -> None:
    """Barrier that sleeps after a while, since a rank that spins occupies a core that others need. Collective."""
    if comm.size == 1:
        return
    everyone, begin = comm.Ibarrier(), time.monotonic()
    while not everyone.Test():
        waited = time.monotonic() - begin
        if waited > SPIN:
            time.sleep(min(SHARE * waited, NAP))


@contextmanager
def raise_on_all_ranks(comm: MPI.Intracomm) -> Iterator[None]:
    """Run a block that may fail on some ranks only; then raise on all of them.

    The exception of the lowest failing rank is raised on every rank, so no rank waits in a collective call that
    the others never reach. The block itself must not communicate.

    Collective. Raises Exception: the exception of the lowest failing rank.
    """
    caught: Exception | None = None
    try:
        yield
    except Exception as error:
        caught = error
    meet(comm)
    failures = [e for e in comm.allgather(caught) if e is not None]
    if failures:
        raise failures[0] from caught
