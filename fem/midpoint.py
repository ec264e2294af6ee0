"""Implicit midpoint rule in momentum form: one solve and one product with K a step (layered damping: K, M and D).

With s = 2/dt, w = z_mid - z_n, momentum pi = M_ee v and l the load at the midpoint,

    S w = l - K z_n + s pi_n,   S = K + s D + s^2 M,     z_{n+1} = z_n + 2 w,   v_{n+1} = 2 s w - v_n,
    s pi_{n+1} = a S w - a (1 + s beta) (K z_{n+1} - K z_n) / 2 - s pi_n,   a = 2 s / (s + alpha)

for D = alpha M + beta K. The textbook form computes pi_{n+1} as M v_{n+1} instead: a second product, and the rounding
error of the factor then acts as a force that feeds energy in every step. In momentum form the same error is a fixed
change of the mass matrix, whose energy is conserved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fem.errors import SolverError
from fem.held import held_operators
from fem.petsc import Array, PETSc, total
from fem.solvers import Reproducible, SolverName, TissueSolver, factor_on_every_rank, make_solver
from fem.system import BlockSystem


def midpoint_matrix(system: BlockSystem, dt: float) -> PETSc.Mat:
    """S = K + s D + s^2 M with s = 2/dt. Collective."""
    s, damping = 2 / dt, system.damping
    S = system.K_ee.copy()
    if damping.beta:
        S.scale(1 + s * damping.beta)
    S.axpy(s * s + s * damping.alpha, system.M_ee, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    if damping.matrix is not None:
        S.axpy(s, damping.matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    return S


@dataclass
class TissueState:
    """Relative displacement and velocity of the tissue as PETSc vectors that share one local array [z; v]."""

    array: Array
    z: PETSc.Vec
    v: PETSc.Vec


def state_on(array: Array, system: BlockSystem) -> TissueState:
    """Wrap a local array [z; v] without copying. Collective."""
    layout = system.layout
    n, sizes = layout.n_local, (layout.n_local, layout.n_e)
    return TissueState(
        array,
        PETSc.Vec().createWithArray(array[:n], size=sizes, bsize=layout.dimension, comm=layout.comm),
        PETSc.Vec().createWithArray(array[n:], size=sizes, bsize=layout.dimension, comm=layout.comm),
    )


class TissueMidpoint:
    """The tissue half of the step, for a load known at the midpoint.

    When every rank holds the whole factor it holds the vectors whole as well, and these calls send no message: all
    ranks compute the same numbers and each writes its own rows into the state.

    Args:
        system: operators.
        dt: step [s].
        solver: name of the linear solver.
        rtol: tolerance of an iterative solver.
        reproducible: see :func:`fem.solvers.factor_on_every_rank`.

    Attributes:
        held: operators on the rows held.
        r, h, w, load: vectors on the rows held; ``load_array``, ``w_array`` ... their arrays.
        K2: -2 K, whose product one call adds to h.
        k: K2 z; a step carries it where damping needs the old one.
        w_own, load_own: the rows of w and load that this rank owns, arrays.
    """

    def __init__(
        self,
        system: BlockSystem,
        dt: float,
        solver: SolverName,
        rtol: float = 1e-10,
        reproducible: Reproducible = "auto",
    ) -> None:
        self.system, self.dt, self.s = system, dt, 2 / dt
        self.held = held_operators(system, factor_on_every_rank(system.layout, solver, reproducible))
        self.G, self.rows = self.held.G, self.held.rows
        self.K2 = self.held.K
        self.K2.scale(-2.0)
        S = self.held.matrix(midpoint_matrix(system, dt))
        with self.held.agree():
            self.solver: TissueSolver = make_solver(S, solver, system.layout, "softgrasp_midpoint_", rtol, reproducible)
        self.r, self.h, self.k, self.w, self.load = (self.K2.createVecLeft() for _ in range(5))
        # views stay valid for the life of a vector; asking PETSc for them costs as much as a short dot product
        self.load_array: Array = self.load.array_w
        self.w_array, self.r_array, self.k_array = self.w.array_w, self.r.array_r, self.k.array_r
        self.w_own: Array = self.w_array[self.rows]
        self.load_own: Array = self.load_array[self.rows]
        self.x = self.w  # w as the state is distributed
        self._move = self._move_all
        if self.held.whole:
            layout = system.layout
            self.x = PETSc.Vec().createWithArray(
                self.w_own, size=(layout.n_local, layout.n_e), bsize=layout.dimension, comm=layout.comm
            )
            self.z = self.w.duplicate()
            self.z_own = self.z.array_r[self.rows]
            self._move = self._move_own
        damping = system.damping
        self.alpha, self.beta = damping.alpha, damping.beta
        self.a = 2 * self.s / (self.s + self.alpha)
        self.b = self.a * (1 + self.s * self.beta) / 2
        self._propagate = self._undamped
        if damping.matrix is not None:
            self._prepare_general()
        elif damping.active:
            self.k_old = self.k.duplicate()
            self.k_old_array = self.k_old.array_r
            self._propagate = self._proportional
        self.work = 0.0
        self.dissipated = 0.0

    def _prepare_general(self) -> None:
        """The damping matrix with its mass-proportional part, so that a step needs one product with it. Collective."""
        self.y = self.k.duplicate()
        self.y_array = self.y.array_r
        if self.held.D is None or self.held.M is None:
            raise SolverError("a damping matrix is missing")
        self.M, self.D = self.held.M, self.held.D.copy()
        self.D.axpy(self.alpha, self.M, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._propagate = self._general

    def start(self, state: TissueState) -> None:
        """Set the carried vectors k = -2 K z and h = s M v - K z. Collective."""
        self.join(state)
        y = state.z.duplicate()
        self.system.M_ee.mult(state.v, y)
        self.h.array_w[:] = self.held.gather(y.array_r)
        y.destroy()
        self.h.scale(self.s)
        self.h.axpy(0.5, self.k)

    def join(self, state: TissueState) -> None:
        """Take a state over whose h is set. Collective."""
        if self.held.whole:
            self.z.array_w[:] = self.held.gather(state.z.array_r)
        self.K2.mult(self._held_z(state), self.k)

    def _held_z(self, state: TissueState) -> PETSc.Vec:
        return self.z if self.held.whole else state.z

    def set_load(self, c: Array) -> None:
        """Load G c of the midpoint for c of shape (n_s,). Not collective."""
        np.dot(self.G, c, out=self.load_array)

    def solve_midpoint(self) -> None:
        """Solve S w = h + l for the load in ``load``. Collective."""
        self.r.waxpy(1.0, self.load, self.h)
        self.solver.solve(self.r, self.w)

    def respond(self) -> Array:
        """Solve S w = h, the step without a load; the owned rows of w. Collective."""
        self.solver.solve(self.h, self.w)
        return self.w_own

    def make_responses(self) -> Array:
        """Set Y = S^{-1} G for :meth:`accelerate`; its owned rows (n_local, n_s). Collective.

        Raises:
            SolverError: a solve missed its tolerance.
        """
        self.Y = np.empty(self.G.shape, order="F")
        with self.held.agree():
            for j in range(self.Y.shape[1]):
                self.r.array_w[:] = self.G[:, j]
                self.solver.solve(self.r, self.w)
                self.solver.check(self.r, self.w, "the response to the hand")
                self.Y[:, j] = self.w.array_r
        return np.asarray(self.Y[self.rows])

    def accelerate(self, c: Array) -> None:
        """Turn S^{-1} h in w into S^{-1} (h - G c), and set load and right-hand side to match. Not collective."""
        w = self.w.array_w  # not the view: PETSc must see that w changed
        w -= self.Y @ c
        np.dot(self.G, -c, out=self.load_array)
        self.r.waxpy(1.0, self.load, self.h)

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write z_{n+1}, v_{n+1} into ``new`` (may be ``old``) and carry k and h on. Collective."""
        z = self._move(old, new)
        self.work += 2.0 * float(np.dot(self.w_own, self.load_own))
        self._propagate(z)

    def _move_all(self, old: TissueState, new: TissueState) -> PETSc.Vec:
        if new is old:
            old.z.axpy(2.0, self.w)
        else:
            new.z.waxpy(2.0, self.w, old.z)
        self._move_velocity(old, new)
        return new.z

    def _move_own(self, old: TissueState, new: TissueState) -> PETSc.Vec:
        self.z.axpy(2.0, self.w)
        new.array[: len(self.z_own)] = self.z_own
        new.z.stateIncrease()
        self._move_velocity(old, new)
        return self.z

    def _move_velocity(self, old: TissueState, new: TissueState) -> None:
        if new is not old:
            old.v.copy(new.v)
        new.v.axpby(2 * self.s, -1.0, self.x)

    def _undamped(self, z: PETSc.Vec) -> None:
        self.h.waxpy(1.0, self.load, self.r)
        self.K2.multAdd(z, self.h, self.h)

    def _proportional(self, z: PETSc.Vec) -> None:
        self.k, self.k_old = self.k_old, self.k
        self.k_array, self.k_old_array = self.k_old_array, self.k_array
        self.K2.mult(z, self.k)
        self.h.axpby(self.a, -1.0, self.r)
        self.h.axpy((1 + self.b) / 2, self.k)
        self.h.axpy((1 - self.b) / 2, self.k_old)
        w, rows = self.w_own, self.rows
        wKw = (np.dot(w, self.k_old_array[rows]) - np.dot(w, self.k_array[rows])) / 4
        wMw = (np.dot(w, self.r_array[rows]) - (1 + self.s * self.beta) * wKw) / (self.s * (self.s + self.alpha))
        self.dissipated += 2 * self.s * float(self.alpha * wMw + self.beta * wKw)

    def _general(self, z: PETSc.Vec) -> None:
        self.M.mult(self.w, self.y)
        self.h.axpby(2 * self.s**2, -1.0, self.y)
        self.h.axpy(0.5, self.k)
        self.K2.mult(z, self.k)
        self.h.axpy(0.5, self.k)
        self.D.mult(self.w, self.y)
        self.dissipated += 2 * self.s * float(np.dot(self.w_own, self.y_array[self.rows]))

    def energy(self, state: TissueState) -> float:
        """Energy (z' K z + v' M v) / 2 [J] of the state just reached, from the carried momentum. Collective."""
        self.K2.mult(self._held_z(state), self.k)
        n, k = len(self.w_own), self.k_array[self.rows] / -2
        z, v = state.array[:n], state.array[n:]
        momentum = (self.h.array_r[self.rows] + k) / self.s
        local = np.array([np.dot(z, k), np.dot(v, momentum)])
        return float(total(self.system.layout.comm, local).sum()) / 2

    def balance(self) -> tuple[float, float]:
        """Work done by the loads and energy dissipated since the start [J]. Collective."""
        work, lost = total(self.system.layout.comm, np.array([self.work, self.dissipated]))
        return float(work), float(lost)

    def residual(self, where: str = "a time step") -> float:
        """Check the last solve; raises SolverError. Collective.

        In equilibrium under gravity the load cancels in r, and a two-way step subtracts the hand's part from w: what is
        left is small against the load, not against the rounding in r.
        """
        # the array, not the vector: it is written through a view, so the norm that PETSc remembers may be an old one
        square = total(self.system.layout.comm, np.array([np.dot(self.load_own, self.load_own)]))[0]
        with self.held.agree():
            return self.solver.check(self.r, self.w, where, float(np.sqrt(square)))

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.solver.destroy()
        self.held.destroy()
        for name in ("r", "h", "k", "x", "w", "load", "k_old", "y", "z", "D"):
            if hasattr(self, name):
                getattr(self, name).destroy()
