"""The order in which Cholesky eliminates the nodes, and the operators of a step on the rows that a rank computes."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.errors import agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, rows_on_all, to_scipy, whole_copy
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class NodeOrder:
    """Nested dissection [GL81] of the nodes of one rank; the d rows of a node stay together."""

    nodes: NDArray[np.intp]  # the node at each place, (nodes,)
    places: NDArray[np.intp]  # the place of each node, its inverse
    d: int  # rows of a node

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) in this order, a copy."""
        return x[_rows(self.nodes, self.d)]

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) of this order as they were before, a copy."""
        return x[_rows(self.places, self.d)]

    def places_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Places of the nodes that had the rows from first to before last."""
        return self.places[first // self.d : last // self.d]

    def rows_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Where the rows from first to before last are now."""
        return _rows(self.places_of(first, last), self.d)


@dataclass(frozen=True)
class Dissection:
    """An order and the pattern of blocks of d x d in it, for as long as matrices are put in order."""

    order: NodeOrder  # of the nodes
    before: tuple[NDArray[Any], NDArray[Any]]  # row pointers and columns of the blocks before
    after: tuple[NDArray[Any], NDArray[Any]]  # the same in this order
    source: NDArray[np.intp]  # where each block of ``after`` stood before

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """A of the same pattern with rows and columns in this order, in blocks of d x d (BAIJ).

        Raises:
            ValueError: A has another pattern.
        """
        blocks = to_scipy(A).tobsr((self.order.d, self.order.d))
        if not all(np.array_equal(a, b) for a, b in zip(self.before, (blocks.indptr, blocks.indices), strict=True)):
            raise ValueError("the matrix does not have the pattern that was dissected")
        csr = (*self.after, blocks.data[self.source])
        result = PETSc.Mat().createBAIJ(A.getSize(), self.order.d, csr=csr, comm=PETSc.COMM_SELF)
        result.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
        return result


def dissect(A: PETSc.Mat, d: int) -> Dissection:
    """Nested dissection of the nodes of a matrix on one rank, d rows a node, with symmetric pattern."""
    blocks = to_scipy(A).tobsr((d, d))
    before = blocks.indptr, blocks.indices
    count = len(blocks.indices)
    size = (len(blocks.indptr) - 1,) * 2
    graph = PETSc.Mat().createAIJ(size, csr=(*before, np.ones(count)), comm=PETSc.COMM_SELF)
    by_row, by_column = graph.getOrdering("nd")
    nodes = by_row.getIndices().astype(np.intp)
    for item in (by_row, by_column, graph):
        item.destroy()
    numbered = scipy.sparse.csr_matrix((np.arange(count), blocks.indices, blocks.indptr), shape=size)
    moved = numbered[nodes][:, nodes]
    moved.sort_indices()
    after = tuple(part.astype(PETSc.IntType) for part in (moved.indptr, moved.indices))
    return Dissection(NodeOrder(nodes, np.argsort(nodes), d), before, after, moved.data)


def _rows(nodes: NDArray[np.intp], d: int) -> NDArray[np.intp]:
    return (nodes[:, None] * d + np.arange(d)).ravel()


@dataclass(frozen=True)
class Held:
    """Stiffness, damping matrix and coupling as one rank steps them."""

    layout: BlockLayout
    whole: bool  # all rows are here, on a communicator of this rank alone
    order: NodeOrder | None  # of the rows held; None: that of the layout
    rows: slice | NDArray[np.intp]  # places of the owned rows among those held
    K: PETSc.Mat  # stiffness, a copy, in blocks of d x d on one rank: a quarter less memory traffic than single entries
    G: Array  # coupling to the hand, (rows held, n_s)
    S: PETSc.Mat  # matrix of the step; whoever factors it owns it
    D: PETSc.Mat | None
    M: PETSc.Mat | None  # mass, only beside D
    parts: tuple[PETSc.Mat, ...] = ()  # further matrices that were asked for, on the same rows; whoever asked owns them

    def agree(self) -> AbstractContextManager[None]:
        """Guard of a block that is a rank's own affair when it holds everything, and collective otherwise. Collective.

        The block must not communicate by itself.
        """
        return agree(self.layout.comm) if self.whole else nullcontext()

    def gather(self, local: Array) -> Array:
        """Rows held of a vector given by its owned rows. Collective."""
        return self.enter(rows_on_all(self.layout.comm, local)) if self.whole else local

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows in the order of the layout as they are held."""
        return x if self.order is None else self.order.enter(x)

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows held in the order of the layout."""
        return x if self.order is None else self.order.leave(x)

    def destroy(self) -> None:
        """Free what is not the system's own. Collective."""
        self.K.destroy()
        if self.whole:
            for A in (self.D, self.M):
                if A is not None:
                    A.destroy()


def held_operators(
    system: BlockSystem, S: PETSc.Mat, whole: bool, ordered: bool, parts: tuple[PETSc.Mat, ...] = ()
) -> Held:
    """Operators of a system on the owned rows, or on all. Collective.

    Args:
        S: matrix of the step, consumed.
        ordered: in the order of elimination; all rows then.
    """
    layout, D = system.layout, system.damping.matrix
    beside = () if D is None else (D, system.M_ee)
    first, last = layout.start, layout.start + layout.n_local
    if not (whole or ordered):
        K = system.K_ee.copy()
        if K.comm.size == 1:  # the conversion of a parallel matrix takes its source apart
            K.convert("baij")
        G, M = np.asfortranarray(system.G), None if D is None else system.M_ee
        return Held(layout, False, None, slice(0, layout.n_local), K, G, S, D, M, parts)
    every = [whole_copy(A) for A in (system.K_ee, S, *beside, *parts)]
    for A in (S, *parts):
        A.destroy()
    G, order = rows_on_all(layout.comm, system.G), None
    rows: slice | NDArray[np.intp] = slice(first, last)
    if ordered:
        dissection = dissect(every[0], layout.dimension)
        for i, A in enumerate(every):
            every[i] = dissection.matrix(A)
            A.destroy()
        order = dissection.order
        G, rows = order.enter(G), order.rows_of(first, last)
    else:
        every[0].convert("baij")
    K, S, *rest = every
    D, M = rest[: len(beside)] or (None, None)
    return Held(layout, True, order, rows, K, np.asfortranarray(G), S, D, M, tuple(rest[len(beside) :]))
