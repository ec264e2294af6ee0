"""Implicit midpoint rule in momentum form: one solve and one product with K a step.

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

from fem.petsc import Array, PETSc, total
from fem.solvers import SolverName, TissueSolver, make_solver
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

    Args:
        system: operators.
        dt: step [s].
        solver: name of the linear solver.
        rtol: tolerance of an iterative solver.
        reproducible: same bits in every parallel run, see :func:`fem.solvers.make_solver`.
    """

    def __init__(
        self, system: BlockSystem, dt: float, solver: SolverName, rtol: float = 1e-10, reproducible: bool = False
    ) -> None:
        self.system, self.dt, self.s = system, dt, 2 / dt
        self.solver: TissueSolver = make_solver(
            midpoint_matrix(system, dt), solver, system.layout, "softgrasp_midpoint_", rtol, reproducible
        )
        # blocks of d x d: a quarter less memory traffic than single entries; on one rank, because the conversion of a
        # parallel matrix takes its source apart
        self.K = system.K_ee.copy()
        if system.layout.comm.size == 1:
            self.K.convert("baij")
        self.r, self.h, self.k, self.w, self.load = (system.K_ee.createVecLeft() for _ in range(5))
        # views stay valid for the life of a vector; asking PETSc for them costs as much as a short dot product
        self.load_array: Array = self.load.array_w
        self.w_array, self.r_array, self.k_array = self.w.array_r, self.r.array_r, self.k.array_r
        damping = system.damping
        self.alpha, self.beta, self.D = damping.alpha, damping.beta, damping.matrix
        self.a = 2 * self.s / (self.s + self.alpha)
        self.b = self.a * (1 + self.s * self.beta) / 2
        self._propagate = self._undamped
        if self.D is not None:
            self.k_old, self.y = self.k.duplicate(), self.k.duplicate()
            self.y_array = self.y.array_r
            self._propagate = self._general
        elif damping.active:
            self.k_old = self.k.duplicate()
            self.k_old_array = self.k_old.array_r
            self._propagate = self._proportional
        self.work = 0.0
        self.dissipated = 0.0

    def start(self, state: TissueState) -> None:
        """Set the carried vectors k = K z and h = s M v - K z. Collective."""
        self.K.mult(state.z, self.k)
        self.system.M_ee.mult(state.v, self.h)
        self.h.scale(self.s)
        self.h.axpy(-1.0, self.k)

    def solve_midpoint(self) -> None:
        """Solve S w = h + l for the load in ``load``. Collective."""
        self.r.waxpy(1.0, self.load, self.h)
        self.solver.solve(self.r, self.w)

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write z_{n+1}, v_{n+1} into ``new`` (may be ``old``) and carry k and h on. Collective."""
        w = self.w
        if new is old:
            old.z.axpy(2.0, w)
            old.v.axpby(2 * self.s, -1.0, w)
        else:
            new.z.waxpy(2.0, w, old.z)
            old.v.copy(new.v)
            new.v.axpby(2 * self.s, -1.0, w)
        self.work += 2.0 * float(np.dot(self.w_array, self.load_array))
        self._propagate(new)

    def _undamped(self, new: TissueState) -> None:
        self.K.mult(new.z, self.k)
        self.h.waxpy(1.0, self.load, self.r)
        self.h.axpy(-2.0, self.k)

    def _proportional(self, new: TissueState) -> None:
        self.k, self.k_old = self.k_old, self.k
        self.k_array, self.k_old_array = self.k_old_array, self.k_array
        self.K.mult(new.z, self.k)
        self.h.axpby(self.a, -1.0, self.r)
        self.h.axpy(-1.0 - self.b, self.k)
        self.h.axpy(self.b - 1.0, self.k_old)
        w = self.w_array
        wKw = (np.dot(w, self.k_array) - np.dot(w, self.k_old_array)) / 2
        wMw = (np.dot(w, self.r_array) - (1 + self.s * self.beta) * wKw) / (self.s * (self.s + self.alpha))
        self.dissipated += 2 * self.s * float(self.alpha * wMw + self.beta * wKw)

    def _general(self, new: TissueState) -> None:
        self.system.M_ee.mult(self.w, self.y)
        self.h.axpby(2 * self.s**2, -1.0, self.y)
        self.h.axpy(-1.0, self.k)
        self.K.mult(new.z, self.k)
        self.h.axpy(-1.0, self.k)
        if self.D is not None:
            self.D.mult(self.w, self.y)
        self.dissipated += 2 * self.s * float(np.dot(self.w_array, self.y_array))
        if self.alpha:
            self.system.M_ee.mult(self.w, self.y)
            self.dissipated += 2 * self.s * self.alpha * float(np.dot(self.w_array, self.y_array))

    def energy(self, state: TissueState) -> float:
        """Energy (z' K z + v' M v) / 2 [J] from the carried vectors. Collective."""
        n = len(self.w_array)
        z, v = state.array[:n], state.array[n:]
        momentum = (self.h.array_r + self.k_array) / self.s
        local = np.array([np.dot(z, self.k_array), np.dot(v, momentum)])
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
        square = total(self.system.layout.comm, np.array([np.dot(self.load_array, self.load_array)]))[0]
        return self.solver.check(self.r, self.w, where, float(np.sqrt(square)))

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.solver.destroy()
        self.K.destroy()
        for name in ("r", "h", "k", "w", "load", "k_old", "y"):
            if hasattr(self, name):
                getattr(self, name).destroy()
