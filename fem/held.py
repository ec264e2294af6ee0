"""The operators of a step on the rows that a rank computes: its own, or all of them in the order of elimination."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fem.errors import agree
from fem.layout import BlockLayout
from fem.order import NodeOrder, node_order
from fem.petsc import Array, PETSc, rows_on_all, whole_copy
from fem.system import BlockSystem


@dataclass(frozen=True)
class Held:
    """Stiffness, damping matrix and coupling as one rank steps them.

    Attributes:
        layout: sizes and ownership.
        whole: all rows are here, on a communicator of this rank alone.
        order: of the rows held; None: that of the layout.
        rows: places of the owned rows among those held.
        K: stiffness, a copy, in blocks of d x d on one rank: a quarter less memory traffic than single entries.
        G: coupling to the hand, (rows held, n_s).
        D: damping matrix, or None.
        M: mass, only beside D.
    """

    layout: BlockLayout
    whole: bool
    order: NodeOrder | None
    rows: slice | NDArray[np.intp]
    K: PETSc.Mat
    G: Array
    D: PETSc.Mat | None
    M: PETSc.Mat | None

    def agree(self) -> AbstractContextManager[None]:
        """Guard of a block that is a rank's own affair when it holds everything, and collective otherwise. Collective.

        The block must not communicate by itself.
        """
        return agree(self.layout.comm) if self.whole else nullcontext()

    def gather(self, local: Array) -> Array:
        """Rows held of a vector given by its owned rows. Collective."""
        return self.enter(rows_on_all(self.layout.comm, local)) if self.whole else local

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows in the order of the layout as they are held. Not collective."""
        return x if self.order is None else self.order.enter(x)

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows held in the order of the layout. Not collective."""
        return x if self.order is None else self.order.leave(x)

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """The matrix on the rows held; consumes A. Collective."""
        if not self.whole:
            return A
        copy = _whole(A, self.order)
        A.destroy()
        return copy

    def destroy(self) -> None:
        """Free what is not the system's own. Collective."""
        self.K.destroy()
        if self.whole:
            for A in (self.D, self.M):
                if A is not None:
                    A.destroy()


def held_operators(system: BlockSystem, whole: bool, ordered: bool) -> Held:
    """Operators of a system on the owned rows, or on all, these on request in the order of elimination. Collective."""
    layout, D = system.layout, system.damping.matrix
    M = None if D is None else system.M_ee
    order, n = None, layout.n_local
    rows: slice | NDArray[np.intp] = slice(0, n)
    if whole:
        K = whole_copy(system.K_ee)
        rows, G = slice(layout.start, layout.start + n), rows_on_all(layout.comm, system.G)
        if ordered:
            every, order = K, node_order(K, layout.dimension)
            K = order.matrix(every)
            every.destroy()
            rows, G = order.leave(np.arange(layout.n_e))[rows], order.enter(G)
        D, M = (None if A is None else _whole(A, order) for A in (D, M))
    else:
        G, K = system.G, system.K_ee.copy()
    if K.comm.size == 1 and order is None:  # the conversion of a parallel matrix takes its source apart
        K.convert("baij")
    return Held(layout, whole, order, rows, K, np.asfortranarray(G), D, M)


def _whole(A: PETSc.Mat, order: NodeOrder | None) -> PETSc.Mat:
    """All rows on every rank, in the order of elimination if there is one. Collective."""
    every = whole_copy(A)
    if order is None:
        return every
    result = order.matrix(every)
    every.destroy()
    return result
