"""Implicit midpoint rule in momentum form: one solve and one product with K a step (layered damping: K, M and D).

With s = 2/dt, w = z_mid - z_n, momentum pi = M_ee v and the load l = G c at the midpoint,

    S w = r,   r = h_n + G c_n,   h_n = s pi_n - K z_n,   S = K + s D + s^2 M,
    z_{n+1} = z_n + 2 w,   v_{n+1} = 2 s w - v_n      (:mod:`softgrasp.fem.run.displacement`),
    s pi_{n+1} = a S w - a (1 + s beta) (K z_{n+1} - K z_n) / 2 - s pi_n,   a = 2 s / (s + alpha)

for D = alpha M + beta K. The textbook form computes pi_{n+1} as M v_{n+1} instead: a second product, and the rounding
error of the factor then acts as a force that feeds energy in every step. In momentum form the same error is a fixed
change of the mass matrix, whose energy is conserved.

Only r is stored. From r_n to h_{n+1} all terms but one work in place (undamped: r_n - 2 K z_{n+1} + G c_n); the last,
G c_n, waits for the next load, so that a step adds G to r once: r_{n+1} = (h_{n+1} - G c_n) + G (c_n + c_{n+1}).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from softgrasp.fem.petsc import SAME, Array, PETSc, combine, total
from softgrasp.fem.run.displacement import Displacement
from softgrasp.fem.solve.differences import Differences
from softgrasp.fem.solve.replicated import replicated_operators
from softgrasp.fem.solve.solvers import Reproducible, SolverName, TissueSolver, factor_on_every_rank, make_solver
from softgrasp.fem.system import BlockSystem, dynamic_stiffness

if TYPE_CHECKING:
    from softgrasp.fem.strain.newton import NewtonFigures


def midpoint_matrix(system: BlockSystem, dt: float) -> PETSc.Mat:
    """S = K + s D + s^2 M with s = 2/dt. Collective."""
    return dynamic_stiffness(system, 2 / dt)


def viscosity(system: BlockSystem, s: float) -> PETSc.Mat:
    """The matrix s D with D = alpha M + beta K [+ layers], with the pattern of M. Collective."""
    damping = system.damping
    layers = [] if damping.matrix is None else [(s, damping.matrix)]
    return combine([(s * damping.alpha, system.M_ee), (s * damping.beta, system.K_ee), *layers])


@dataclass
class TissueState:
    """Displacement and velocity of the tissue against the hand, as PETSc vectors on one local array."""

    array: Array  # [z; v] of this rank's nodes, (2 n_local,) [m; m/s]
    z: PETSc.Vec  # displacement against the hand, on the first half of ``array``, (n_e,) [m]
    v: PETSc.Vec  # velocity against the hand, on the second half of ``array``, (n_e,) [m/s]


def state_on(array: Array, system: BlockSystem) -> TissueState:
    """Wrap a local array [z; v] without copying. Collective."""
    layout = system.layout
    n, sizes = layout.n_local, (layout.n_local, layout.n_e)
    return TissueState(
        array,
        PETSc.Vec().createWithArray(array[:n], size=sizes, bsize=layout.dimension, comm=layout.comm),
        PETSc.Vec().createWithArray(array[n:], size=sizes, bsize=layout.dimension, comm=layout.comm),
    )


class Feedback(NamedTuple):
    """Load G C p with p = N'w that a two-way coupled hand, or a controller, adds to the load G c of a step.

    In a substepped step w is (z_1 - z_0) / 2 in the share 1 - speed of each column, (v_0 + v_1) / 2s in the rest.
    """

    C: Array  # load coefficients of the m sensed components, (n_s, m)
    N: Array  # sensing columns on the rows here, (rows, m)
    speed: Array  # share of each column that senses the velocity [1], (m,)


class TissueMidpoint:
    """The tissue half of the step, for a load known at the midpoint.

    When every rank stores the whole factor it stores the whole vectors too, and these calls send no message: all
    ranks compute the same numbers, in the order in which the factor has its rows, and each writes its own rows into
    the state.

    Args:
        dt: step [s].
        rtol: tolerance of an iterative solver.
        reproducible: see :func:`softgrasp.fem.solve.solvers.factor_on_every_rank`.

    Attributes:
        operators: operators of the step, on the rows here.
        r: right-hand side of the step, on the rows here; ``r_array`` is its array.
        w: half the change of z in the step, z_mid - z_n, on the rows here [m]; ``w_array`` is its array.
        c: coefficients of the load of the step in work, (n_s,).
        pending: coefficients p of the load that r still lacks between steps, h = r + G p, (n_s,).
        K2: -2 K, whose product one call adds to r, see :mod:`softgrasp.fem.solve.differences`.
        k: K2 z, on the rows here [N]; carried from step to step where damping is on; ``k_array`` is its array.
        z: z on the rows here where these are all rows; else None, and the state has it.
        low: what z lacks, see :mod:`softgrasp.fem.run.displacement`, on the rows here [m].
    """

    SUBTREES: ClassVar[bool] = True
    """Whether linear steps ask nothing but solves of the factor, so that each rank may store a subtree."""

    def __init__(
        self,
        system: BlockSystem,
        dt: float,
        solver: SolverName,
        rtol: float = 1e-10,
        reproducible: Reproducible = "auto",
    ) -> None:
        self.system, self.dt, self.s = system, dt, 2 / dt
        linear = self.SUBTREES and system.points is None and system.frame is None
        whole = factor_on_every_rank(system.layout, solver, reproducible, linear)
        ordered = solver == "cholesky" and whole
        self.operators = replicated_operators(system, midpoint_matrix(system, dt), whole, ordered, self._parts())
        self.G, self.rows = self.operators.G, self.operators.rows
        self.K2 = self.operators.K2
        with self.operators.raise_on_all_ranks():
            self.solver: TissueSolver = make_solver(
                self.operators.S, solver, system.layout, "softgrasp_midpoint_", rtol, reproducible, ordered, not whole
            )
        self._solve = self.solver.solve if self.solver.factor is None else self.solver.factor.solve
        self.r, self.k, self.w = (self.K2.createVecLeft() for _ in range(3))
        # views stay valid for the life of a vector; a call of PETSc for them needs the time of a short dot product
        self.w_array, self.r_array, self.k_array = self.w.array_w, self.r.array_r, self.k.array_r
        self._couple()
        own = system.own_load
        self.own: Array | None = None if own is None else np.asarray(self.operators.gather(own))
        self.z: PETSc.Vec | None = self.w.duplicate() if self.operators.whole else None
        self.low = self.w.duplicate()
        self.low.array_w[:] = 0.0
        # K (z + low) needs compiled code
        self._lows = (self.low,) if isinstance(self.K2, Differences) else ()
        self.displacement = self._make_displacement()
        self.dissipated = 0.0
        self.spare: list[PETSc.Vec] = []  # of velocity.py, made once a run
        self._prepare()

    def _parts(self) -> tuple[PETSc.Mat, ...]:
        """Further matrices that every rank stores whole. Collective."""
        return ()

    def _prepare(self) -> None:
        """Choose the update at the end of a step by the damping. Collective."""
        damping = self.system.damping
        self.alpha, self.beta = damping.alpha, damping.beta
        self.a = 2 * self.s / (self.s + self.alpha)
        self.b = self.a * (1 + self.s * self.beta) / 2
        self._propagate = self._undamped if self.own is None else self._undamped_loaded
        if damping.matrix is not None:
            self._prepare_general()
        elif damping.active:
            self.k_old = self.k.duplicate()
            self.k_old_array = self.k_old.array_r
            self._propagate = self._proportional

    def _make_displacement(self) -> Displacement:
        layout, order, z = self.system.layout, self.operators.order, self.z
        d = layout.dimension
        own = layout.start // d, (layout.start + layout.n_local) // d
        nodes = np.arange(*own) if order is None else order.places[slice(*own)]
        return Displacement(self.w_array, self.low.array_w, self.s, None if z is None else z.array_w, nodes, d)

    def _couple(self) -> None:
        """G as a dense matrix of this rank alone, with vectors that share the arrays of r and w.

        PETSc adds a product to r, or multiplies by w, in one pass and with less overhead than NumPy.
        """
        n_s = self.G.shape[1]
        self.coupling = PETSc.Mat().createDense(self.G.shape, array=np.asfortranarray(self.G), comm=PETSc.COMM_SELF)
        self.coupling.assemble()
        self.r_here, self.w_here = (
            PETSc.Vec().createWithArray(array, comm=PETSc.COMM_SELF) for array in (self.r.array_w, self.w_array)
        )
        self.added, self.moved = (PETSc.Vec().createSeq(n_s, comm=PETSc.COMM_SELF) for _ in range(2))
        self.added_array: Array = self.added.array_w
        self.moved_array: Array = self.moved.array_r
        self.c, self.pending = np.zeros(n_s), np.zeros(n_s)

    def _prepare_general(self) -> None:
        """The damping matrix with its mass-proportional part, so that a step needs one product with it. Collective."""
        self.y = self.k.duplicate()
        self.y_array = self.y.array_r
        assert self.operators.D is not None
        assert self.operators.M is not None
        self.M, self.D = self.operators.M, self.operators.D.copy()
        self.D.axpy(self.alpha, self.M, SAME)
        self._propagate = self._general

    def start(self, state: TissueState) -> None:
        """Set the carried vectors k = -2 K z and r = h = s M v - K z. Collective."""
        self._set_momentum(state)
        self.r.axpy(0.5, self.k)

    def _set_momentum(self, state: TissueState) -> None:
        """Set r = s M v with no load pending, and low to zero. Collective."""
        self.low.array_w[:] = 0.0  # PETSc does not see that C code writes into it
        self.adopt(state)
        y = state.z.duplicate()
        self.system.M_ee.mult(state.v, y)
        self.r.array_w[:] = self.s * self.operators.gather(y.array_r)
        y.destroy()
        self.c = self.pending = np.zeros_like(self.c)

    def adopt(self, state: TissueState) -> None:
        """Continue from a state whose r is set. Collective."""
        self._pull_back(self._gathered_z(state))

    def _pull_back(self, z: PETSc.Vec) -> None:
        """Set k = -2 (K z - f), f the load of own terms. Collective."""
        self.K2.mult(z, self.k, *self._lows)
        if self.own is not None:
            self.k.array_w[:] += 2 * self.own

    def _gathered_z(self, state: TissueState) -> PETSc.Vec:
        """The rows here of a new state. Collective."""
        if self.z is not None:
            self.z.array_w[:] = self.operators.gather(state.z.array_r)
        return self._held_z(state)

    def _held_z(self, state: TissueState) -> PETSc.Vec:
        return state.z if self.z is None else self.z

    def solve_midpoint(self, c: Array, feedback: Feedback | None = None) -> None:
        """Solve S w = h + G c, once a step. Collective.

        Args:
            c: load, (n_s,); kept, not copied: leave it as it is until the next solve.
            feedback: of finite strain only.
        """
        np.add(self.pending, c, out=self.added_array)
        self.coupling.multAdd(self.added, self.r_here, self.r_here)
        self.r.stateIncrease()  # else PETSc remembers the norm of the old r
        self.c = c
        self._solve(self.r, self.w)

    def _load(self, c: Array) -> Array:
        """G c and the load of own terms on the rows here [N]."""
        return np.asarray(self.G @ c + (0.0 if self.own is None else self.own))

    def respond(self) -> Array:
        """Solve S w = h, the step without a load; the owned rows of w. Collective."""
        self.solve_midpoint(np.zeros_like(self.c))
        return self.owned()

    def owned(self) -> Array:
        """The owned rows of w; a copy where all rows are here."""
        return np.asarray(self.w_array[self.rows])

    def make_responses(self) -> Array:
        """Set Y = S^{-1} G for :meth:`accelerate`; its owned rows (n_local, n_s). Collective.

        Call it before :meth:`start`: r is scratch here, and a run in progress would be lost. Raises SolverError: a
        solve missed its tolerance.
        """
        self.Y = np.empty(self.G.shape, order="F")
        with self.operators.raise_on_all_ranks():
            for j in range(self.Y.shape[1]):
                self.r.array_w[:] = self.G[:, j]
                self.solver.solve(self.r, self.w)
                self.solver.check(self.r, self.w, "the response to the hand")
                self.Y[:, j] = self.w.array_r
        return np.asarray(self.Y[self.rows])

    def accelerate(self, c: Array) -> None:
        """Turn S^{-1} h in w into S^{-1} (h - G c), and the right-hand side and the load to match."""
        w = self.w.array_w  # not the view: PETSc must see that w changed
        w -= self.Y @ c
        self.c = self.added_array[:] = -c
        self.coupling.multAdd(self.added, self.r_here, self.r_here)
        self.r.stateIncrease()

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write z_{n+1}, v_{n+1} into ``new`` (may be ``old``) and carry k and r on. Collective."""
        self.displacement.move(old.array, new.array)
        z = self._held_z(new)
        for vector in (z, new.z, new.v):  # else PETSc remembers their norms
            vector.stateIncrease()
        self._propagate(z)
        self.pending = self.c

    def pull(self) -> Array:
        """G'w over the rows here, (n_s,), valid until the next call; the load G c of the step does the work 2 c'G'w.

        Own loads f have f'w behind it, (n_s + 1,).
        """
        self.coupling.multTranspose(self.w_here, self.moved)
        if self.own is not None:
            return np.append(self.moved_array, np.dot(self.own, self.w_array))
        return self.moved_array

    def work(self, loads: Array, pulls: Array) -> float:
        """Work of the loads in all of these steps, over the rows here [J]; arguments as for :meth:`works`."""
        own = 0.0 if self.own is None else float(pulls[:, loads.shape[1]].sum())
        return 2 * (float(np.einsum("ij,ij", loads, pulls[:, : loads.shape[1]])) + own)

    def works(self, loads: Array, pulls: Array) -> Array:
        """Work 2 c'G'w of the load in each step, over the rows here, (steps,) [J].

        Args:
            loads: coefficients c of each step, (steps, n_s).
            pulls: what :meth:`pull` returned after it, (steps, ..).
        """
        own = 0.0 if self.own is None else pulls[:, loads.shape[1]]
        return np.asarray(2 * ((loads * pulls[:, : loads.shape[1]]).sum(axis=1) + own))

    def _undamped(self, z: PETSc.Vec) -> None:
        self.K2.multAdd(z, self.r, self.r, *self._lows)

    def _undamped_loaded(self, z: PETSc.Vec) -> None:
        self._pull_back(z)
        self.r.axpy(1.0, self.k)

    def _proportional(self, z: PETSc.Vec) -> None:
        self.k, self.k_old = self.k_old, self.k
        self.k_array, self.k_old_array = self.k_old_array, self.k_array
        self._pull_back(z)
        w = self.w_array
        wKw = (np.dot(w, self.k_old_array) - np.dot(w, self.k_array)) / 4
        wMw = (np.dot(w, self.r_array) - (1 + self.s * self.beta) * wKw) / (self.s * (self.s + self.alpha))
        self.dissipated += 2 * self.s * float(self.alpha * wMw + self.beta * wKw)
        self.r.axpby((1 + self.b) / 2, self.a - 1, self.k)
        self.r.axpy((1 - self.b) / 2, self.k_old)

    def _general(self, z: PETSc.Vec) -> None:
        self.M.mult(self.w, self.y)
        self.r.axpby(2 * self.s**2, -1.0, self.y)
        self.r.axpy(0.5, self.k)
        self._pull_back(z)
        self.r.axpy(0.5, self.k)
        self.D.mult(self.w, self.y)
        self.dissipated += 2 * self.s * float(np.dot(self.w_array, self.y_array))

    def energy(self, state: TissueState) -> float:
        """Energy (z' K z + v' M v) / 2 [J] of the state just reached, from the carried momentum. Collective."""
        self._pull_back(self._held_z(state))
        n, k = self.system.layout.n_local, self.k_array[self.rows] / -2
        z, v = state.array[:n], state.array[n:]
        h = self.r_array[self.rows] + self.G[self.rows] @ self.pending
        momentum = (h + k) / self.s
        k = k if self.own is None else k + self.own[self.rows]
        local = np.array([np.dot(z, k), np.dot(v, momentum)])
        return float(total(self.system.layout.comm, local).sum()) / 2

    def over_ranks(self, share: float) -> float:
        """Sum over the ranks of a number that each computed on its rows here, which may be all rows. Collective."""
        return share if self.operators.whole else float(total(self.system.layout.comm, np.array([share]))[0])

    def residual(self) -> float:
        """Check a solve, before :meth:`advance` moves r on; raises SolverError. Collective.

        In equilibrium under gravity the load cancels in r, and a two-way step subtracts the hand's part from w: what is
        left is small against the load, not against the rounding in r.
        """
        with self.operators.raise_on_all_ranks():
            return self.solver.check(self.r, self.w, "the midpoint", self.load_size())

    def load_size(self) -> float:
        """Norm of the load of the step in work [N]. Collective."""
        load = self._load(self.c)[self.rows]
        return float(np.sqrt(total(self.system.layout.comm, np.array([np.dot(load, load)]))[0]))

    def solve_error(self) -> float:
        """Estimated error of z by solves that end early, energy norm, over the largest z [1]; 0 with a factor."""
        return 0.0

    def figures(self) -> NewtonFigures | None:
        """Convergence of the steps so far; None where they are linear. Collective."""
        return None

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file, beside r and the state, by their names there."""
        return {}

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what :meth:`restart_arrays` returned, after :meth:`adopt`. Collective."""

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.solver.destroy()
        self.operators.destroy()
        for vector in self.spare:
            vector.destroy()
        for name in ("r", "k", "w", "r_here", "w_here", "low", "added", "moved", "coupling", "k_old", "y", "z", "D"):
            if getattr(self, name, None) is not None:
                getattr(self, name).destroy()
