"""Quadrature points of the tissue: H = grad z as one sparse product, with volume, material and cell of every point.

f(z) = B' (vol P(B z)) and K(z) = B' (vol A(B z)) B, for any element order, dimension and rank count, without DOLFINx.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, PETSc, rows_on_all, to_scipy, whole_copy
from softgrasp.fem.strain.laws import LAWS, Law

Ints = NDArray[np.intp]


@dataclass(frozen=True)
class QuadraturePoints:
    """The Q quadrature points of this rank's cells."""

    # gradient H = B z [1], rows distributed as the points and columns as the tissue; of the rank's d^2 Q rows the row
    # (i d + j) Q + q is H_ij = dz_i/dX_j in its point q, so that H is an array (d, d, Q)
    B: PETSc.Mat
    # weight of each point [m^d, in 2D times the thickness], (Q,); they sum to the volume of the rank's cells
    vol: Array
    layer: Ints  # number of the layer of each point, (Q,)
    cell: Ints  # global number of the cell of each point, (Q,)
    X: Array  # place of each point at rest [m], (Q, d)
    d: int  # space dimension
    law: str | Law  # name of the material's law, or a law of the user's own
    tol: float  # relative tolerance of the equations of a step [1]
    # function from the points and the layers' materials to the inputs of an own law, (Q,) each; None for a named law
    own: Callable[[QuadraturePoints, tuple[LayerMaterial, ...]], tuple[Array, ...]] | None = None

    @property
    def laws(self) -> Law:
        """The law, by its name where it has one."""
        return LAWS[self.law] if isinstance(self.law, str) else self.law

    def moduli(self, materials: tuple[LayerMaterial, ...]) -> tuple[Array, ...]:
        """What the law needs of every point beside H, (Q,) each: Lame's lambda and mu [Pa], or the own law's inputs."""
        if self.own is not None:
            return self.own(self, materials)
        lam, mu = (np.array([getattr(m, key) for m in materials]) for key in ("lam", "mu"))
        return lam[self.layer], mu[self.layer]


def make_gradient(comm: MPI.Intracomm, gradients: Array, nodes: Ints, columns: tuple[int, int]) -> PETSc.Mat:
    """The matrix B of :class:`QuadraturePoints` from the gradients of the nodes' shape functions. Collective.

    Args:
        gradients: dN_a/dX_j in every point of every cell, (cells, points, nodes, d).
        nodes: global number of each cell's nodes among the free ones, negative for nodes that follow the hand,
            (cells, nodes).
        columns: number of tissue unknowns on this rank and on all [1].
    """
    cells, each, _, d = gradients.shape
    Q = cells * each
    point = np.arange(Q).reshape(cells, each, 1)
    free = np.broadcast_to(nodes[:, None] >= 0, gradients.shape[:3])
    rows, cols, values = [], [], []
    for i in range(d):
        col = np.broadcast_to(nodes[:, None] * d + i, free.shape)[free]
        for j in range(d):
            rows.append(np.broadcast_to(point + (i * d + j) * Q, free.shape)[free])
            cols.append(col)
            values.append(gradients[..., j][free])
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
    B = scipy.sparse.coo_matrix(entries, shape=(d * d * Q, columns[1])).tocsr()  # keeps zeros: the pattern is that of K
    return _petsc(B, ((d * d * Q, None), columns), d, comm)


def node_arrays(points: QuadraturePoints, lanes: int) -> tuple[Any, Array, int, int]:
    """Nodes of the points and gradients of their shape functions, by chunks of ``lanes`` points, B on one rank.

    Returns numbers of the nodes, (p / lanes, k, lanes), dN_a / dX_j, (p / lanes, k, d, lanes), as `force.c` reads them,
    the number k of nodes of a point, and the number p of points, rounded up to whole chunks.
    """
    B, d, Q = to_scipy(points.B), points.d, len(points.vol)
    counts = np.diff(B.indptr[: Q + 1])  # the rows of a point have the same nodes
    point, k, p = np.repeat(np.arange(Q), counts), int(counts.max(initial=0)), -(-Q // lanes) * lanes
    place = np.arange(len(point)) - np.repeat(B.indptr[:Q], counts)
    node, G = np.zeros((p, k), dtype=np.intc), np.zeros((p, k, d))
    node[point, place] = B.indices[: len(point)] // d
    for j in range(d):
        G[point, place, j] = B.data[B.indptr[j * Q] : B.indptr[(j + 1) * Q]]
    node = np.ascontiguousarray(node.reshape(-1, lanes, k).swapaxes(1, 2))
    G = np.ascontiguousarray(G.reshape(-1, lanes, k, d).transpose(0, 2, 3, 1))
    return node, G, k, p


def whole_points(points: QuadraturePoints, comm: MPI.Intracomm, columns: Ints | None = None) -> QuadraturePoints:
    """The points of all ranks on every rank, as a matrix B of that rank alone. Collective.

    ``columns``: number of the present column for each new column of B; None keeps the order.
    """
    every = whole_copy(points.B)
    B = to_scipy(every)
    every.destroy()
    counts, d = comm.allgather(len(points.vol)), points.d
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    # rank by rank the rows are ordered by component; on one rank all points of a component are together
    rows = [
        d * d * first + component * count + np.arange(count)
        for component in range(d * d)
        for first, count in zip(firsts, counts, strict=True)
    ]
    B = B[np.concatenate(rows)]
    if columns is not None:
        B = B[:, columns]
    B.sort_indices()
    vol, layer, cell, X = (rows_on_all(comm, part) for part in (points.vol, points.layer, points.cell, points.X))
    return replace(points, B=_petsc(B, B.shape, d, MPI.COMM_SELF), vol=vol, layer=layer, cell=cell, X=X)


def _petsc(B: scipy.sparse.csr_matrix, size: object, d: int, comm: MPI.Intracomm) -> PETSc.Mat:
    csr = (B.indptr.astype(PETSc.IntType), B.indices.astype(PETSc.IntType), B.data)
    result = PETSc.Mat().createAIJ(size, csr=csr, comm=comm)
    result.setBlockSizes(1, d)
    return result
