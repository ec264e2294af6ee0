"""The operators of a step on the rows that a rank computes: its own, or all of them in the order of elimination."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, rows_on_all, whole_copy
from softgrasp.fem.solve.cholesky import NodeOrder, dissect
from softgrasp.fem.solve.differences import Differences, minus_twice, require_same_code
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class ReplicatedOperators:
    """Operators of a step on the rows that this rank computes ("the rows here")."""

    layout: BlockLayout  # sizes and ownership of the unknowns
    whole: bool  # whether all rows are here, on a communicator of this rank alone
    order: NodeOrder | None  # order of the rows here; None: that of the layout
    rows: slice | NDArray[np.intp]  # places of the owned rows among those here, (n_local,)
    K2: Differences | PETSc.Mat  # -2 K [N/m], (rows here, n_e)
    G: Array  # coupling to the hand, (rows here, n_s) [kg, kg m]
    S: PETSc.Mat  # matrix of the step, owned by the solver that factors it, (rows here, n_e) [N/m]
    D: PETSc.Mat | None  # damping matrix of layers that differ in beta, (rows here, n_e) [N s/m]; else None
    M: PETSc.Mat | None  # mass beside D, (rows here, n_e) [kg]; None without D
    parts: tuple[PETSc.Mat, ...] = ()  # further matrices on the rows here, owned by the caller

    def raise_on_all_ranks(self) -> AbstractContextManager[None]:
        """Guard of a block that is a rank's own affair when it has all rows, and collective otherwise. Collective.

        The block must not communicate by itself.
        """
        return raise_on_all_ranks(self.layout.comm) if self.whole else nullcontext()

    def gather(self, local: Array) -> Array:
        """Rows here of a vector given by its owned rows. Collective."""
        return self.enter(rows_on_all(self.layout.comm, local)) if self.whole else local

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows in the order of the layout as they lie here."""
        return x if self.order is None else self.order.enter(x)

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows here in the order of the layout."""
        return x if self.order is None else self.order.leave(x)

    def destroy(self) -> None:
        """Free what is not the system's own. Collective."""
        self.K2.destroy()
        if self.whole:
            for A in (self.D, self.M):
                if A is not None:
                    A.destroy()


def replicated_operators(
    system: BlockSystem, S: PETSc.Mat, whole: bool, ordered: bool, parts: tuple[PETSc.Mat, ...] = ()
) -> ReplicatedOperators:
    """Operators of a system on the owned rows, or on all. Collective.

    Args:
        S: matrix of the step, consumed.
        ordered: in the order of elimination; all rows then.

    Raises SolverError: some ranks have compiled code and some have none.
    """
    layout, D = system.layout, system.damping.matrix
    require_same_code(layout.comm)
    beside = () if D is None else (D, system.M_ee)
    first, last = layout.start, layout.start + layout.n_local
    if not (whole or ordered):
        k2 = minus_twice(system.K_ee, layout.dimension)
        G, M = np.asfortranarray(system.G), None if D is None else system.M_ee
        return ReplicatedOperators(layout, False, None, slice(0, layout.n_local), k2, G, S, D, M, parts)
    K, *every = (whole_copy(A) for A in (system.K_ee, S, *beside, *parts))
    for A in (S, *parts):
        A.destroy()
    G, order = rows_on_all(layout.comm, system.G), None
    rows: slice | NDArray[np.intp] = slice(first, last)
    dissection = dissect(K, layout.dimension) if ordered else None
    k2 = minus_twice(K, layout.dimension, dissection)
    K.destroy()
    if dissection is not None:
        for i, A in enumerate(every):
            every[i] = dissection.matrix(A)
            A.destroy()
        order = dissection.order
        G, rows = order.enter(G), order.rows_of(first, last)
    S, *rest = every
    D, M = rest[: len(beside)] or (None, None)
    return ReplicatedOperators(layout, True, order, rows, k2, np.asfortranarray(G), S, D, M, tuple(rest[len(beside) :]))
