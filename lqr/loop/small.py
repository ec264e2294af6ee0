"""A small dense plant, projected from the full one or any reduced model, and its loop: the same midpoint rule."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from softgrasp.fem.columns import labels
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc, normalising, on_root, times_columns, total
from softgrasp.lqr.dense.modal import TissueMatrices, assemble_space
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.cost import accumulated_cost
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.operators import damp
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import steady_input
from softgrasp.reduction.lti import LTI, make_lti


@dataclass(frozen=True)
class SmallPlant:
    """E x' = A x + B u + f, y = C x, q_s = S_q x, v_s = S_v x, of dimension N."""

    E: Array  # (N, N)
    A: Array  # (N, N)
    B: Array  # (N, n_s)
    C: Array  # (p, N)
    f: Array  # constant load, gravity (N,)
    S_q: Array  # (n_s, N)
    S_v: Array  # (n_s, N)
    names: tuple[str, ...] = ()  # one per output

    @property
    def N(self) -> int:
        """Dimension."""
        return len(self.E)

    @property
    def hand_first(self) -> bool:
        """Whether the state begins with q_s and v_s."""
        n_s, one = len(self.S_q), np.eye(self.N)
        return np.array_equal(self.S_q, one[:n_s]) and np.array_equal(self.S_v, one[n_s : 2 * n_s])

    def lti(self) -> LTI:
        """The system for other packages, and for frequency responses; ``lti().under(K)`` is the closed loop."""
        return make_lti(self.E, self.A, self.B, self.C, self.names, self.hand_first)

    def rest_at(self, q_bar: Array) -> tuple[Array, Array]:
        """x_bar (N,) and u_bar (n_s,) with 0 = A x + B u + f and S_q x = q_bar.

        Raises ControlError: the plant has no such state, or more than one.
        """
        n_s = len(self.S_q)
        K = np.block([[self.A, self.B], [self.S_q, np.zeros((n_s, n_s))]])
        scale = np.abs(K).max(axis=1)
        right = np.concatenate([-self.f, np.asarray(q_bar, dtype=np.float64)])
        if (scale == 0).any() or not np.linalg.cond(K / scale[:, None]) < 1e14:  # rounding: no digit would be right
            raise ControlError("the reduced plant has no unique state of rest for a position of the hand")
        solution = np.linalg.solve(K / scale[:, None], right / scale)
        return solution[: self.N], solution[self.N :]


@dataclass(frozen=True)
class Shapes:
    """Reduced displacement z ~ V eta of k columns, and the filter eta = W' z."""

    V: Array  # displacement basis, local rows (n_local, k)
    W: Array  # filter M_ee V (V' M_ee V)^{-1} with W'V = I, local rows (n_local, k)

    def reduce(self, problem: RiccatiProblem, x: PlantState) -> Array:
        """[q_s, v_s, W'z, W'v_z], (2 n_s + 2 k,), on every rank. Collective."""
        tissue = total(problem.layout.comm, np.stack([self.W.T @ x.z, self.W.T @ x.v_z]))
        return np.concatenate([x.q_s, x.v_s, tissue.ravel()])

    def expand(self, problem: RiccatiProblem, x: Array) -> PlantState:
        """The full state of a reduced one."""
        n_s, k = problem.layout.n_s, self.V.shape[1]
        q, v, eta, rate = np.split(np.asarray(x), [n_s, 2 * n_s, 2 * n_s + k])
        return PlantState(q, v, self.V @ eta, self.V @ rate)

    def reduce_gain(self, problem: RiccatiProblem, gain: Gain) -> Array:
        """K V = [K_s, K_z'V, K_v'V]: the full gain on states of the form V eta, (n_s, N). Collective."""
        tissue = total(problem.layout.comm, np.stack([gain.K_z.T @ self.V, gain.K_v.T @ self.V]))
        return np.hstack([gain.K_s, tissue[0], tissue[1]])

    def expand_gain(self, problem: RiccatiProblem, K: Array) -> Gain:
        """The gain on the full state that is u = K [q_s, v_s, W'z, W'v_z]."""
        n_s, k = problem.layout.n_s, self.V.shape[1]
        return Gain(K[:, : 2 * n_s], self.W @ K[:, 2 * n_s : 2 * n_s + k].T, self.W @ K[:, 2 * n_s + k :].T)


def galerkin(problem: RiccatiProblem, V: Array) -> tuple[SmallPlant, Shapes]:
    """Galerkin on x = [q_s, v_s, V eta, V eta']: the hand stays whole, the tissue stays of second order.

    V'M V, V'D V and V'K V keep their definiteness, so the reduced plant is as stable as the full one, for every V.
    Collective. ``V``: shapes of z, local rows (n_local, k), linearly independent; k = 0 leaves the hand alone.

    Raises ControlError: the columns of V are linearly dependent.
    """
    system, comm = problem.system, problem.layout.comm
    M_V, K_V = times_columns(system.M_ee, V), times_columns(system.K_ee, V)
    D_V = damp(system, V)
    k, n_s = V.shape[1], problem.layout.n_s
    small = total(comm, np.stack([V.T @ M_V, V.T @ K_V, V.T @ D_V]))
    M, K, D = (small + small.transpose(0, 2, 1)) / 2
    G, C_z = total(comm, V.T @ system.G), total(comm, V.T @ problem.C_z)
    size = np.diag(M)
    values = np.linalg.eigvalsh(M / np.sqrt(np.outer(size, size))) if (size > 0).all() else np.zeros(1)
    if not values.min(initial=1.0) > 1e-12:  # rounding of the products is about 1e-15 k
        raise ControlError(f"the {k} shapes of the tissue are linearly dependent; orthonormalise them first")
    space = assemble_space(problem, TissueMatrices(M, K, D, G, C_z))
    f = np.zeros(len(space.E))
    if system.gravity is not None:
        f[2 * n_s + k :] = G @ system.gravity
    f[n_s : 2 * n_s] = -steady_input(system)
    S = np.eye(2 * n_s, len(f))
    plant = SmallPlant(space.E, space.A, space.B, space.C, f, S[:n_s], S[n_s:], labels(problem.columns))
    return plant, Shapes(V, np.linalg.solve(M, M_V.T).T)


def m_orthonormal(M: PETSc.Mat, V: Array, tolerance: float = 1e-10) -> Array:
    """Columns that span V with V' M V = I; directions below ``tolerance`` of the largest are dropped. Collective."""
    comm = M.comm.tompi4py()
    for _ in range(2):  # the second pass repairs what rounding left after the first
        V = V @ on_root(comm, partial(normalising, total(comm, V.T @ times_columns(M, V)), tolerance**2))
    return np.asfortranarray(V)


@dataclass(frozen=True)
class ReducedLoopTrajectory:
    """Result of a reduced run."""

    times: Array  # time grid [s], (steps + 1,)
    states: Array  # reduced states, (steps + 1, N)
    q_s: Array  # displacement of the hand [m, rad], (steps + 1, n_s)
    inputs: Array  # input u of each step [N, N m], (steps, n_s)
    outputs: Array  # outputs y [m, rad], (steps + 1, p)
    cost: Array  # cost J up to each grid point, (steps + 1,)
    saturated: float  # share of the steps with an input at its limit
    seconds: dict[str, float] = field(default_factory=dict)  # time of "prepare" and "steps" [s]


class ReducedLoop:
    """E x' = A x + B u + f with u = u_bar + K (x - x_bar), implicit midpoint.

    x_mid = P x_n + Y u + b with P = S^{-1} E, Y = dt/2 S^{-1} B, b = dt/2 S^{-1} f, S = E - dt/2 A, and
    x_{n+1} = 2 x_mid - x_n; at the midpoint u = u_0 + K Y u is solved for the few inputs. Not collective: every rank
    may run its own. Raises ControlError: dt is not positive, or E - dt/2 A is singular.
    """

    def __init__(self, plant: SmallPlant, dt: float) -> None:
        if not (np.isfinite(dt) and dt > 0):
            raise ControlError(f"dt = {dt} s must be a positive number")
        self.plant, self.dt = plant, dt
        self.seconds = time.perf_counter()
        try:
            columns = np.linalg.solve(
                plant.E - dt / 2 * plant.A, np.hstack([plant.E, dt / 2 * plant.B, dt / 2 * plant.f[:, None]])
            )
        except np.linalg.LinAlgError as error:
            raise ControlError(f"E - dt/2 A of the reduced plant is singular for dt = {dt:g} s") from error
        self.P, self.Y, self.b = columns[:, : plant.N], columns[:, plant.N : -1], columns[:, -1]
        self.seconds = time.perf_counter() - self.seconds

    def run(
        self,
        K: Array,
        rest: tuple[Array, Array],
        steps: int,
        weights: tuple[Array, Array],
        actuation: Actuation | None = None,
        start: Array | None = None,
    ) -> ReducedLoopTrajectory:
        """Run for some steps.

        Args:
            K: gain, (n_s, N).
            rest: x_bar and u_bar, see :meth:`SmallPlant.rest_at`.
            weights: Q and R of the cost.
            start: x(0), default the state of rest with the hand at 0.

        Raises:
            ControlError: gain or actuation do not fit the plant.
            SolverError: the loop diverged.
        """
        plant, actuation = self.plant, actuation or Actuation()
        n_s = plant.B.shape[1]
        if K.shape != (n_s, plant.N):
            raise ControlError(f"the gain has the shape {K.shape}; this plant needs ({n_s}, {plant.N})")
        begin = time.perf_counter()
        x_bar, u_bar = rest
        x = plant.rest_at(np.zeros(n_s))[0] if start is None else np.asarray(start, dtype=np.float64)
        bound, every = actuation.bound(n_s), actuation.ticks(self.dt)
        states, inputs = np.empty((steps + 1, plant.N)), np.empty((steps, n_s))
        states[0] = x
        offset = u_bar - K @ x_bar
        with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverges is reported below
            if every:
                self._held(states, inputs, K, offset, u_bar, actuation)
            elif bound is None:
                self._affine(states, inputs, K, offset)
            else:
                self._limited(states, inputs, K, offset, bound)
        bad = ~(np.abs(states).max(axis=1) < 1e100)  # far above any state of use
        if bad.any():
            raise SolverError(
                f"the reduced closed loop diverged before t = {self.dt * int(np.argmax(bad)):.6g} s; this gain does "
                "not stabilise the plant at this rate, delay and limit"
            )
        outputs = states @ plant.C.T
        cost = accumulated_cost(outputs - plant.C @ x_bar, inputs - u_bar, *weights, self.dt)
        return ReducedLoopTrajectory(
            times=np.asarray(self.dt * np.arange(steps + 1), dtype=np.float64),
            states=states,
            q_s=states @ plant.S_q.T,
            inputs=inputs,
            outputs=outputs,
            cost=cost,
            saturated=actuation.saturated(inputs),
            seconds={"prepare": self.seconds, "steps": time.perf_counter() - begin},
        )

    def _affine(self, states: Array, inputs: Array, K: Array, offset: Array) -> None:
        """Without limits a step is one product with a small matrix."""
        law = ImplicitInput(K @ self.Y, None)
        L, c = law.inverse @ (K @ self.P), law.inverse @ (offset + K @ self.b)
        step, shift = 2 * (self.P + self.Y @ L), 2 * (self.b + self.Y @ c)
        step[np.diag_indices(len(step))] -= 1.0
        for n in range(len(inputs)):
            states[n + 1] = step @ states[n] + shift
        inputs[:] = states[:-1] @ L.T + c

    def _limited(self, states: Array, inputs: Array, K: Array, offset: Array, bound: Array) -> None:
        law = ImplicitInput(K @ self.Y, bound)
        for n in range(len(inputs)):
            free = self.P @ states[n] + self.b
            inputs[n] = law.solve(offset + K @ free)
            states[n + 1] = 2 * (free + self.Y @ inputs[n]) - states[n]

    def _held(self, states: Array, inputs: Array, K: Array, offset: Array, u_bar: Array, actuation: Actuation) -> None:
        bound, every = actuation.bound(len(u_bar)), actuation.ticks(self.dt)
        limit = np.full(len(u_bar), np.inf) if bound is None else bound
        waiting = deque([np.clip(u_bar, -limit, limit)] * (actuation.delay + 1), actuation.delay + 1)
        step, shift = 2 * self.P - np.eye(len(self.P)), 2 * self.b
        for n in range(len(inputs)):
            if n % every == 0:
                waiting.append(np.clip(offset + K @ states[n], -limit, limit))
                drive = shift + 2 * self.Y @ waiting[0]
            inputs[n] = waiting[0]
            states[n + 1] = step @ states[n] + drive
