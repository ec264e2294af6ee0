"""Columns of M^-1 at the nodes that obstacles stop, for the mass M of one component, M_ee = M x I.

A column decays by about a third from node to node, so that only a neighbourhood is reached before rounding; each is
solved for when an impulse first needs it, and kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import compiled

Array = NDArray[Any]
Ints = NDArray[np.intp]
SOURCE = Path(__file__).with_name("mass.c")
DECLARATION = """int softgrasp_mass(int n, const int *ptr, const int *col, const double *M, const double *inverse,
  int most, double rtol, int *order, int count, double *x, double *room, char *in);"""
MOST = 1000  # rounds; about thirty are usual
RTOL = 1e-15  # preconditioned norm of the residual over that of the right-hand side
DENSE = 0.25  # share of entries above which the columns are kept as an array


class NodalMass:
    """Responses of the velocity to unit impulses on nodes.

    Args:
        M: mass of one component, symmetric, positive definite, (nodes, nodes) [kg].
        here: nodes whose rows are kept, from the first to before the last.
        engine: "C" or "NumPy"; empty takes C where there is a compiler.

    Attributes:
        nodes: node of every column.
        kept: nodes here that M^-1 e of every column reaches, and its values there [1/kg].
        block: values at the nodes of the columns, (count, count) [1/kg].
    """

    def __init__(self, M: csr_matrix, here: tuple[int, int], engine: str = "") -> None:
        M.sort_indices()
        self.M, self.here, n = M, here, M.shape[0]
        self.inverse = 1 / M.diagonal()
        self.code = None if engine == "NumPy" else compiled(SOURCE, DECLARATION)
        self.where = np.full(n, -1)
        self.nodes: Ints = np.zeros(0, dtype=np.intp)
        self.block = np.zeros((0, 0))
        self.kept: list[tuple[Ints, Array]] = []
        self._joined: Any = np.zeros((here[1] - here[0], 0))
        self.order, self.x, self.room, self.marks = np.zeros(n, np.intc), np.zeros(n), np.zeros(3 * n), np.zeros(n, "b")

    def enter(self, nodes: Ints) -> None:
        """Make the columns of nodes that have none, in the order given. Raises SolverError: no convergence."""
        new = np.array(list(dict.fromkeys(nodes[self.where[nodes] < 0].tolist())), dtype=np.intp)
        if not len(new):
            return
        have = len(self.nodes)
        self.where[new] = np.arange(have, have + len(new))
        self.nodes = np.concatenate([self.nodes, new])
        block = np.zeros((len(self.nodes),) * 2)
        block[:have, :have] = self.block
        for j, node in enumerate(new.tolist(), have):
            order, x = self.solve(np.array([node]), np.ones(1))
            self.x[order] = x
            block[j, : j + 1] = block[: j + 1, j] = self.x[self.nodes[: j + 1]]
            self.x[order] = 0.0
            mine = (order >= self.here[0]) & (order < self.here[1])
            self.kept.append((order[mine] - self.here[0], x[mine]))
        self.block = block

    @property
    def columns(self) -> Any:
        """M^-1 e of every column on the rows here, (rows here, count) [1/kg]."""
        shape = self.here[1] - self.here[0], len(self.kept)
        if self._joined.shape != shape:
            ends, rows, values = self.entries()
            columns = csc_matrix((values, rows, ends), shape=shape)
            self._joined = columns if len(values) < DENSE * shape[0] * shape[1] else columns.toarray(order="F")
        return self._joined

    def entries(self) -> tuple[Ints, Ints, Array]:
        """Where each column begins, and nodes and values of all that is kept; there must be a column."""
        rows, values = (np.concatenate(parts) for parts in zip(*self.kept, strict=True))
        return np.cumsum([0, *(len(each) for each, _ in self.kept)]), rows, values

    def solve(self, nodes: Ints, b: Array) -> tuple[Ints, Array]:
        """Nodes (m,) that M^-1 b reaches, and its values there, for b (k,) at k nodes, zero elsewhere.

        Raises SolverError: the iteration does not converge.
        """
        if self.code is None:
            return self._in_numpy(nodes, b)
        ffi, code = self.code
        self.order[: len(nodes)], self.x[nodes] = nodes, b

        def at(values: Array, kind: str = "double[]") -> object:
            return ffi.from_buffer(kind, values)

        count: int = code.softgrasp_mass(
            len(self.x), at(self.M.indptr, "int[]"), at(self.M.indices, "int[]"), at(self.M.data), at(self.inverse),
            MOST, RTOL, at(self.order, "int[]"), len(nodes), at(self.x), at(self.room), at(self.marks, "char[]"),
        )  # fmt: skip
        if count < 0:
            self.x[:] = 0.0
            raise _unsolved()
        reached = self.order[:count].astype(np.intp)
        values = self.x[reached]
        self.x[reached] = 0.0
        return reached, values

    def _in_numpy(self, nodes: Ints, b: Array) -> tuple[Ints, Array]:
        """The same iteration on all nodes."""
        r, x = np.zeros(len(self.x)), np.zeros(len(self.x))
        r[nodes] = b
        p = self.inverse * r
        rho = float(r @ p)
        least = RTOL**2 * rho
        for _ in range(MOST):
            if rho <= least:
                return np.flatnonzero(x), x[x != 0]
            q = self.M @ p
            step = rho / float(p @ q)
            x += step * p
            r -= step * q
            new = float(r @ (self.inverse * r))
            p, rho = self.inverse * r + new / rho * p, new
        raise _unsolved()


def _unsolved() -> SolverError:
    return SolverError(f"the impulse of contact did not converge in {MOST} iterations; improve the mesh")
