"""The order in which Cholesky eliminates the nodes, and rows and matrices in that order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.petsc import PETSc, to_scipy


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
