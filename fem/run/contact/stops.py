"""Impulses before half-spaces: what `contact.c` needs of M^-1 for the rows that ever touched."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.model.surface import Surface
from softgrasp.fem.obstacles.mass import NodalMass
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.contact.strike import Strike
from softgrasp.fem.system import BlockSystem


class Stopped(Protocol):
    """A contact whose rows `contact.c` stops, see :class:`softgrasp.fem.run.contact.flat.FlatContact`."""

    ffi: Any
    """Its cffi."""
    f: Any
    """Struct of `flat.h`."""
    W: Array
    """N S^-1 N' with room for more rows."""
    row: NDArray[np.intc]
    """Obstacle, node, column and direction of each row, (k, 4)."""
    along: Array
    """Directions of each obstacle, (obstacles, 1 + m, d)."""
    d: int
    """Axes."""
    strike: Strike
    """Its impulses."""
    surface: Surface
    """Its boundary."""
    system: BlockSystem
    """Its matrices."""
    layout: BlockLayout
    """Its unknowns."""

    def point(self, **arrays: NDArray[Any]) -> None:
        """Let fields of the struct point at arrays, which are kept."""


class Stops:
    """A = N M^-1 N' of the first rows of a contact, with the hand's part, and the columns of M^-1 behind it.

    Rows get theirs together, when an impulse first needs one. Every number is that of its column or pair of columns
    alone, so that a resumed run has the same bits.
    """

    def __init__(self, contact: Stopped) -> None:
        self.contact, self.A, self.reach = contact, np.zeros((0, 0)), np.zeros((0, 0))

    @property
    def mass(self) -> NodalMass:
        """M^-1 of one component."""
        return self.contact.strike.reactions().mass

    def grow(self, size: int) -> None:
        """Room for rows, beside those there; none before the first impulse."""
        have = len(self.A)
        if not have:
            return
        A, reach = np.zeros((size, size)), np.zeros((size, self.reach.shape[1]))
        A[:have, :have], reach[:have] = self.A, self.reach
        self.A, self.reach, self.contact.f.stopping = A, reach, 0
        self.contact.point(A=A, LA=np.zeros((size, size)), stopped=np.zeros(size, np.intc), reach=reach)

    def enter(self) -> None:
        """Make the columns of all rows. Collective. Raises SolverError: a column of M^-1 does not converge."""
        impulses = self.contact.strike.reactions()
        impulses.mass.enter(impulses.numbers[self.contact.row[:, 1]])
        self.extend()

    def extend(self) -> None:
        """Take in the rows that follow and whose nodes have columns. Collective."""
        contact, impulses = self.contact, self.contact.strike.impulses
        if impulses is None or contact.surface.B is not None or not len(impulses.mass.nodes):
            return
        f, mass, have = contact.f, impulses.mass, int(contact.f.struck)
        at = mass.where[impulses.numbers[contact.row[:, 1]]]
        count = int(np.append(at < 0, True).argmax())
        if count == have:
            return
        if not len(self.A):
            self._begin()
        at, row, new = at[:count], contact.row[:count], slice(have, count)
        along = contact.along[row[:, 0], row[:, 3]]
        # sums of few terms by einsum, whose bits do not depend on the number of rows
        more = mass.block[np.ix_(at, at[new])] * np.einsum("ia,ja->ij", along, along[new])
        if f.feels:
            self.reach[new] = impulses.reach_of(row[new, 1].astype(np.intp), along[new])
            answers = np.einsum("ij,kj->ki", np.linalg.inv(impulses.H), self.reach[new])
            more += np.einsum("ik,jk->ij", self.reach[:count], answers)
        both = more[new]  # of pairs of new rows the entry above the diagonal counts, as if they came one by one
        both[:] = np.triu(both) + np.triu(both, 1).T
        self.A[:count, new], self.A[new, :count] = more, more.T
        f.struck = count
        contact.point(column=(at if mass.swept else mass.nodes[at]).astype(np.intc))

    def _begin(self) -> None:
        """Room for all rows, and what impulses do to the hand. Collective."""
        contact, impulses = self.contact, self.contact.strike.reactions()
        self.A, self.reach = np.zeros((1, 1)), np.zeros((1, contact.f.n_s))
        self.grow(len(contact.W))
        f, mass = contact.f, impulses.mass
        f.nodes = mass.given.shape[1]
        f.mass = mass.swept.f if mass.swept else contact.ffi.NULL
        contact.point(
            given=mass.given, found=mass.found, place=impulses.places.astype(np.intc),
            starts=np.ascontiguousarray(impulses.starts),
        )  # fmt: skip
        if f.feels:
            contact.point(
                X_hand=np.ascontiguousarray(impulses.X.T), H=np.ascontiguousarray(np.linalg.inv(impulses.H)),
                GX=np.ascontiguousarray(total(contact.layout.comm, contact.system.G.T @ impulses.X)),
            )  # fmt: skip
