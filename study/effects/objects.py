"""What PETSc itself counts: the matrices, vectors and solvers that a scene creates, and that its steps create."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

from softgrasp.fem.petsc import PETSc

STEPS = 10  # in which nothing may be created
OWN = "Viewer"  # made by the count itself


def created(comm: MPI.Intracomm) -> dict[str, int]:
    """Objects created so far, by class, from the table "Object Type Creations" of PETSc's log on rank 0. Collective.

    The log counts from the first ``PETSc.Log.begin()`` of the process; numpy arrays are not in it.
    """
    with tempfile.TemporaryDirectory() as folder:
        name = comm.bcast(str(Path(folder) / "log.txt"))
        viewer = PETSc.Viewer().createASCII(name, "w", comm=comm)
        PETSc.Log.view(viewer)
        viewer.destroy()
        text = Path(name).read_text() if comm.rank == 0 else ""
        return dict(comm.bcast(read_table(text)))


def read_table(text: str) -> dict[str, int]:
    """Class and number of creations from the text of PETSc's log."""
    counts: dict[str, int] = {}
    inside = False
    for line in text.splitlines():
        if line.startswith("Object Type"):
            inside = True
        elif inside and line.startswith("==="):
            break
        elif inside and len(parts := line.rsplit(None, 2)) == 3 and parts[1].isdigit() and parts[2].isdigit():
            name = parts[0].strip()
            counts[name] = counts.get(name, 0) + int(parts[1])  # one row a stage
    counts.pop(OWN, None)
    return counts


@contextmanager
def counting(comm: MPI.Intracomm) -> Iterator[dict[str, int]]:
    """Fills the dictionary with what is created inside. Collective."""
    PETSc.Log.begin()
    before, counts = created(comm), dict[str, int]()
    yield counts
    counts.update({name: n - before.get(name, 0) for name, n in created(comm).items() if n > before.get(name, 0)})


def difference(more: dict[str, int], less: dict[str, int]) -> dict[str, int]:
    """What the one has more, or less, of each class than the other."""
    return {name: d for name in sorted({*more, *less}) if (d := more.get(name, 0) - less.get(name, 0))}


def in_words(objects: dict[str, int]) -> str:
    """Such as "+1 vector, +2 matrix"."""
    return ", ".join(f"{n:+d} {name.lower()}" for name, n in objects.items()) or "none"
