"""The operators of a step on the rows that a rank computes: its own, or all of them."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np

from fem.errors import agree
from fem.layout import BlockLayout
from fem.petsc import Array, PETSc, rows_on_all
from fem.system import BlockSystem


@dataclass(frozen=True)
class Held:
    """Stiffness, damping matrix and coupling as one rank steps them.

    Attributes:
        layout: sizes and ownership.
        whole: all rows are here, on a communicator of this rank alone.
        rows: the owned rows among those held.
        K: stiffness, a copy, in blocks of d x d on one rank: a quarter less memory traffic than single entries.
        G: coupling to the hand, (rows held, n_s).
        D: damping matrix, or None.
        M: mass, only beside D.
    """

    layout: BlockLayout
    whole: bool
    rows: slice
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
        return rows_on_all(self.layout.comm, local) if self.whole else local

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """The matrix on the rows held; consumes A. Collective."""
        if not self.whole:
            return A
        copy = whole_copy(A)
        A.destroy()
        return copy

    def destroy(self) -> None:
        """Free what is not the system's own. Collective."""
        self.K.destroy()
        if self.whole:
            for A in (self.D, self.M):
                if A is not None:
                    A.destroy()


def held_operators(system: BlockSystem, whole: bool) -> Held:
    """Operators of a system on the owned rows, or on all. Collective."""
    layout, D = system.layout, system.damping.matrix
    M = None if D is None else system.M_ee
    if whole:
        rows = slice(layout.start, layout.start + layout.n_local)
        G = np.asfortranarray(rows_on_all(layout.comm, system.G))
        K = whole_copy(system.K_ee)
        D, M = (None if A is None else whole_copy(A) for A in (D, M))
    else:
        rows, G, K = slice(0, layout.n_local), system.G, system.K_ee.copy()
    if K.comm.size == 1:  # the conversion of a parallel matrix takes its source apart
        K.convert("baij")
    return Held(layout, whole, rows, K, G, D, M)


def whole_copy(A: PETSc.Mat) -> PETSc.Mat:
    """All rows of a distributed matrix, on every rank. Collective."""
    every = PETSc.IS().createStride(A.getSize()[0], 0, 1, comm=PETSc.COMM_SELF)
    every.setBlockSize(A.getBlockSize())
    (copy,) = A.createSubMatrices([every], [every])
    copy.setBlockSize(A.getBlockSize())
    copy.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
    every.destroy()
    return copy
