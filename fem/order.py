"""The order in which Cholesky eliminates the nodes, and rows and matrices in that order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fem.petsc import PETSc


@dataclass(frozen=True)
class NodeOrder:
    """Nested dissection [GL81] of the nodes of one rank; the d rows of a node stay together.

    Attributes:
        nodes: the node at each place, (nodes,).
        places: the place of each node, its inverse.
        d: rows of a node.
        indptr, indices: pattern of the blocks of d x d in this order.
        source: where each of them stood before, among the blocks in the order of their rows.
    """

    nodes: NDArray[np.intp]
    places: NDArray[np.intp]
    d: int
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    source: NDArray[np.intp]

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) in this order, a copy. Not collective."""
        return x[_rows(self.nodes, self.d)]

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) of this order as they were before, a copy. Not collective."""
        return x[_rows(self.places, self.d)]

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """A of the same pattern with rows and columns in this order, in blocks of d x d (BAIJ). Not collective.

        Raises:
            ValueError: A has another pattern.
        """
        blocks = _blocks(A, self.d)
        if len(blocks.indices) != len(self.source):
            raise ValueError(f"{len(blocks.indices)} blocks, but the order is for a pattern of {len(self.source)}")
        csr = (self.indptr, self.indices, blocks.data[self.source])
        result = PETSc.Mat().createBAIJ(A.getSize(), self.d, csr=csr, comm=PETSc.COMM_SELF)
        result.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
        return result


def node_order(A: PETSc.Mat, d: int) -> NodeOrder:
    """Nested dissection of the nodes of a matrix on one rank, d rows a node, with symmetric pattern. Not collective."""
    blocks = _blocks(A, d)
    size = (len(blocks.indptr) - 1,) * 2
    graph = (blocks.indptr, blocks.indices, np.ones(len(blocks.indices)))
    pattern = PETSc.Mat().createAIJ(size, csr=graph, comm=PETSc.COMM_SELF)
    found, same = pattern.getOrdering("nd")
    nodes = found.getIndices().astype(np.intp)
    for thing in (found, same, pattern):
        thing.destroy()
    numbered = scipy.sparse.csr_matrix((np.arange(len(blocks.indices)), blocks.indices, blocks.indptr), shape=size)
    moved = numbered[nodes][:, nodes]
    moved.sort_indices()
    integer = PETSc.IntType
    return NodeOrder(
        nodes, np.argsort(nodes), d, moved.indptr.astype(integer), moved.indices.astype(integer), moved.data
    )


def _blocks(A: PETSc.Mat, d: int) -> Any:
    """A in blocks of d x d, as SciPy has them."""
    indptr, columns, values = A.getValuesCSR()
    return scipy.sparse.csr_matrix((values, columns, indptr), shape=A.getSize()).tobsr((d, d))


def _rows(nodes: NDArray[np.intp], d: int) -> NDArray[np.intp]:
    return (nodes[:, None] * d + np.arange(d)).ravel()
