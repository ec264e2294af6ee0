"""M^-1 for the impulses of obstacles, for the mass M of one component, M_ee = M x I.

With a factor, M^-1 = B F in two sweeps, see :mod:`softgrasp.fem.solve.sweeps`: the first sweep of each node that an
obstacle stops is kept, which has few entries, and an impulse costs one second sweep. The factor has about a d^2-th of
the entries of that of a step. Where every rank cannot store one, conjugate gradients solve, which reach a neighbourhood
of the nodes: a column decays by about a third from node to node.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import CODE, compiled
from softgrasp.fem.obstacles.lower import DECLARATION, LowerFactor
from softgrasp.fem.obstacles.responses import TOGETHER
from softgrasp.fem.obstacles.swept import SweptColumns

Array = NDArray[Any]
Ints = NDArray[np.intp]
SOURCE = CODE / "mass.c"
MOST = 1000  # rounds; about thirty are usual
FACTORED = {2: 500_000, 3: 50_000}  # most nodes, by axes, whose mass is factored: 0.2 GB, and 0.6 while it is made
RTOL = 1e-15  # preconditioned norm of the residual over that of the right-hand side


class NodalMass:
    """Responses of the velocity to impulses on nodes, by conjugate gradients.

    Args:
        M: mass of one component, symmetric, positive definite, (nodes, nodes) [kg].
        d: axes.
        engine: "C" or "NumPy"; empty takes C where there is a compiler.

    Attributes:
        nodes: nodes with a column of M^-1.
        where: column of each node, or -1.
        block: M^-1 at these nodes, (count, count) [1/kg].
        places: place of each node in ``given`` and ``found``.
        given: impulses on the nodes of each axis, or sums of first sweeps, (d, nodes).
        found: what `answer` made of it, M^-1 of the impulses, the same.
    """

    def __init__(self, M: csr_matrix, d: int, engine: str = "") -> None:
        n = M.shape[0]
        self.where = np.full(n, -1)
        self.nodes: Ints = np.zeros(0, dtype=np.intp)
        self.block = np.zeros((0, 0))
        self.places = np.arange(n)
        self.given: Array = np.zeros((d, n))
        self.found: Array = np.zeros((d, n))
        M.sort_indices()
        self.M, self.inverse = M, 1 / M.diagonal()
        self.code = None if engine == "NumPy" else compiled(SOURCE, DECLARATION)
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
        for j, row in enumerate(self._rows(have), have):
            block[j, : j + 1] = block[: j + 1, j] = row
        self.block = block

    def _rows(self, have: int) -> list[Array]:
        """Rows of ``block`` up to the diagonal, from ``have`` on."""
        rows = []
        for j, node in enumerate(self.nodes[have:].tolist(), have):
            order, x = self.solve(np.array([node]), np.ones(1))
            self.x[order] = x
            rows.append(self.x[self.nodes[: j + 1]])
            self.x[order] = 0.0
        return rows

    @property
    def swept(self) -> SweptColumns | None:
        """First sweeps of the columns, whose sums ``given`` takes; None: it takes the impulses on the nodes."""
        return None

    def jump(self, impulses: Array) -> Array:
        """M^-1 of impulses (count, d) on the nodes with columns, as in ``found``."""
        self.given[:] = 0.0
        self._sum(impulses)
        self.answer(len(self.given))
        return self.found

    def _sum(self, impulses: Array) -> None:
        """Add impulses (count, d) to ``given``."""
        self.given[:, self.nodes] += impulses.T

    def answer(self, ways: int) -> None:
        """Set the first ``ways`` rows of ``found`` from those of ``given``. Raises SolverError: no convergence."""
        for b, x in zip(self.given[:ways], self.found[:ways], strict=True):
            x[:] = self.respond(b)

    def respond(self, b: Array) -> Array:
        """M^-1 b of all nodes, (nodes,). Raises SolverError: no convergence."""
        x, on = np.zeros(len(b)), np.flatnonzero(b)
        if len(on):
            reached, values = self.solve(on, b[on])
            x[reached] = values
        return x

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


class SweptMass(NodalMass):
    """`NodalMass` by a factor, M = L E L' = C C' with ones on the diagonal of L and a diagonal E.

    Args:
        order: nodes in the order of elimination.
        code: (ffi, library) of `contact.c`; there must be a compiler.

    Attributes:
        C: diagonal of C.
        kept: columns F e = C^-1 e of the nodes with a column of M^-1.
    """

    def __init__(self, M: csr_matrix, d: int, order: Ints, code: Any) -> None:
        super().__init__(M, d)
        lu = splu(
            M[order][:, order].tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        self.places[order], self.C = lu.perm_c, np.sqrt(lu.U.diagonal())
        self.L, self.kept = LowerFactor(lu.L, self.code), SweptColumns(np.ones((len(order), 1, 1)), code)

    @property
    def swept(self) -> SweptColumns | None:
        """See :attr:`NodalMass.swept`."""
        return self.kept

    def _rows(self, have: int) -> list[Array]:
        """See :meth:`NodalMass._rows`."""
        rows = []
        for first in range(have, len(self.nodes), TOGETHER):
            places = self.places[self.nodes[first : first + TOGETHER]]
            columns = np.zeros((len(self.C), len(places)), order="F")
            for column, place in zip(columns.T, places.tolist(), strict=True):
                column[place] = 1.0
                self.L.ahead(column)
            self.kept.append(columns / self.C[:, None])
            rows += [self.kept.products(first + j) for j in range(len(places))]
        return rows

    def _sum(self, impulses: Array) -> None:
        """See :meth:`NodalMass._sum`."""
        for t, to in zip(np.ascontiguousarray(impulses.T), self.given, strict=True):
            self.kept.combine(t, to)

    def answer(self, ways: int) -> None:
        """See :meth:`NodalMass.answer`."""
        np.divide(self.given[:ways], self.C, out=self.found[:ways])
        self.L.back(self.found[:ways])

    def respond(self, b: Array) -> Array:
        """See :meth:`NodalMass.respond`."""
        x = np.zeros(len(b))
        x[self.places] = b
        self.L.ahead(x)
        x /= self.C**2
        self.L.back(x)
        return x[self.places]


def _unsolved() -> SolverError:
    return SolverError(f"the impulse of contact did not converge in {MOST} iterations; improve the mesh")
