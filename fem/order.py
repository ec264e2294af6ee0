"""The order in which Cholesky eliminates the nodes, and rows in that order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fem.petsc import PETSc


@dataclass(frozen=True)
class NodeOrder:
    """Nested dissection [GL81] of the nodes of one rank; the d rows of a node stay together.

    Attributes:
        nodes: the node at each place, (nodes,).
        places: the place of each node, its inverse.
        d: rows of a node.
    """

    nodes: NDArray[np.intp]
    places: NDArray[np.intp]
    d: int

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) in this order, a copy. Not collective."""
        return x[_rows(self.nodes, self.d)]

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) of this order as they were before, a copy. Not collective."""
        return x[_rows(self.places, self.d)]

    def permute(self, A: PETSc.Mat) -> PETSc.Mat:
        """Rows and columns of A in this order, a new matrix with the same options. Not collective."""
        rows = PETSc.IS().createGeneral(_rows(self.nodes, self.d).astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        result = A.permute(rows, rows)
        rows.destroy()
        result.setBlockSize(self.d)
        result.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
        return result


def node_order(A: PETSc.Mat) -> NodeOrder:
    """Nested dissection of the nodes of a matrix with symmetric pattern; its block size says what a node is.

    Not collective: A lives on one rank.
    """
    blocks = A.convert("baij", PETSc.Mat())
    found, same = blocks.getOrdering("nd")
    nodes = found.getIndices().astype(np.intp)
    for thing in (found, same, blocks):
        thing.destroy()
    return NodeOrder(nodes, np.argsort(nodes), A.getBlockSize())


def _rows(nodes: NDArray[np.intp], d: int) -> NDArray[np.intp]:
    return (nodes[:, None] * d + np.arange(d)).ravel()
