"""Impulses on boundary nodes: M u = N'y for the jump u of the velocity of tissue and hand.

With X = M^-1 G of a hand that feels the tissue, H = M_hand + M_rigid - G'X and B = N T - N X,

    A = N M^-1 N' + B H^-1 B',   u = M^-1 N'y - X a,   a = H^-1 B'y.

M is the same for every component, so that a node costs one column of its inverse for all directions, see
:mod:`softgrasp.fem.obstacles.mass`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from softgrasp.fem.model.surface import Surface
from softgrasp.fem.obstacles.compiled import RIDGE, contact_library
from softgrasp.fem.obstacles.mass import FACTORED, NodalMass, SweptMass
from softgrasp.fem.obstacles.small import SHARES
from softgrasp.fem.petsc import Array, rows_on_all, to_scipy, total, whole_copy
from softgrasp.fem.solve.cholesky import nested_dissection
from softgrasp.fem.system import BlockSystem

Ints = NDArray[np.intp]


class Impulses:
    """What impulses on the boundary do. Making one is collective, and nothing else: every rank keeps the mass.

    Args:
        system: of the run.
        surface: its boundary.
        free: whether the hand feels them.
        order: nodes in the order of elimination, where the step has one.

    Attributes:
        starts: M^-1 G on the boundary, (p d, n_s).
    """

    def __init__(self, system: BlockSystem, surface: Surface, free: bool, order: Ints | None = None) -> None:
        layout, (_, d) = system.layout, surface.X.shape
        self.d, self.surface, self.numbers = d, surface, surface.dofs[::d] // d
        M = system.M_ee if layout.comm.size == 1 else whole_copy(system.M_ee)
        one = to_scipy(M)[::d, ::d].tocsr()
        if M is not system.M_ee:
            M.destroy()
        if one.shape[0] > FACTORED[d] or (code := contact_library()) is None:
            self.mass = NodalMass(one, d)
        else:
            order = nested_dissection(one.indptr, one.indices) if order is None else order
            self.mass = SweptMass(one, d, order, code)
        first, self.n, self.n_s = layout.start // d, layout.n_local, layout.n_s if free else 0
        self.places = self.mass.places[first : first + self.n // d]  # of the nodes here in a jump
        self.X, self.H = np.zeros((layout.n_local, 0)), np.zeros((0, 0))
        self.reach, self.G = np.zeros((surface.X.size, 0)), system.G
        self._couple(system, free)
        self.key, self.A, self.factor = b"", np.zeros((0, 0)), (np.zeros((0, 0)), True)

    def _couple(self, system: BlockSystem, free: bool) -> None:
        """Responses to the hand. Collective."""
        comm, d, X = system.layout.comm, self.d, rows_on_all(system.layout.comm, system.G)
        for column in X.T:
            for axis in range(d):
                column[axis::d] = self.mass.respond(column[axis::d].copy())
        self.starts = np.column_stack([self.surface.at_points(x) for x in X[self.surface.dofs].T])
        if not free:
            return
        first = system.layout.start
        self.X = X[first : first + self.n]
        self.H = system.M_hand + system.M_rigid - total(comm, system.G.T @ self.X)
        self.reach = self.surface.T - self.starts

    def matrix(self, nodes: Ints, directions: Array) -> Array:
        """A (k, k) [1/kg] of unit impulses on boundary nodes (k,) along unit vectors (k, d); kept for the same ones.

        Raises SolverError: a column of M^-1 does not converge.
        """
        key = nodes.tobytes() + directions.tobytes()
        if key != self.key:
            at, shares = self._at(nodes)
            block = self.mass.block[np.ix_(at, at)]
            self.A = (block if shares is None else shares @ block @ shares.T) * (directions @ directions.T)
            if self.n_s:
                B = self.reach_of(nodes, directions)
                self.A += B @ np.linalg.solve(self.H, B.T)
            self.key, self.factor = key, (np.zeros((0, 0)), True)
        return self.A

    def _at(self, points: Ints) -> tuple[Ints, Array | None]:
        """Columns (m,) of the nodes on which points (k,) act, and the share of each point (k, m); None: one node each.

        Raises SolverError: see `matrix`.
        """
        nodes, shares = (points, None) if self.surface.B is None else self.surface.weights(points)
        self.mass.enter(self.numbers[nodes])
        return self.mass.where[self.numbers[nodes]], shares

    def reach_of(self, nodes: Ints, directions: Array) -> Array:
        """B, (k, n_s)."""
        return np.asarray(np.einsum("ki,kij->kj", directions, self.reach.reshape(-1, self.d, self.n_s)[nodes]))

    def stop(self, nodes: Ints, directions: Array, b: Array) -> Array:
        """Impulses y (k,) [N s] with A y = b, b (k,) [m/s]; equal rows share them. Raises SolverError: see `matrix`."""
        A = self.matrix(nodes, directions)
        if not len(self.factor[0]):
            ridge = RIDGE if self.surface.B is None else SHARES[0]
            ridged = A + ridge * np.diag(A.diagonal())
            self.factor = cho_factor(ridged, lower=True, overwrite_a=True, check_finite=False)
        y = cho_solve(self.factor, b, check_finite=False)
        for _ in range(1 if self.surface.B is None else 4):  # without the ridge's error
            y += cho_solve(self.factor, b - A @ y, check_finite=False)
        return np.asarray(y)

    def jump(self, nodes: Ints, directions: Array, y: Array) -> tuple[Array, Array, Array]:
        """Jump of the velocity (n_local,) [m/s], that of the hand (n_s,), and what the momentum gains, M u (n_local,).

        For impulses y (k,) [N s] on the nodes and directions of the last `matrix`.
        """
        each, (at, shares) = y[:, None] * directions, self._at(nodes)
        on_columns = np.zeros((len(self.mass.nodes), self.d))
        np.add.at(on_columns, at, each if shares is None else shares.T @ each)
        u, gained = self.mass.jump(on_columns)[:, self.places].T.ravel(), np.zeros(self.n)
        forces = np.zeros(self.surface.X.shape)
        np.add.at(forces, nodes, each)
        gained[self.surface.rows] = self.surface.on_nodes(forces.ravel())[self.surface.mine]
        if not self.n_s:
            return u, np.zeros(0), gained
        a = np.linalg.solve(self.H, self.reach_of(nodes, directions).T @ y)
        return u - self.X @ a, a, gained - self.G @ a
