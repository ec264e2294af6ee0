"""Small control problems with dense matrices, optimal gains and plain loops of their own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.columns import OutputColumn
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.target import rest
from tests.helpers.models import gather_matrix, gather_rows, gather_states, local_rows, make_scene

Array = np.ndarray
KV: dict[str, Any] = {"damping": {"kind": "kelvin-voigt", "beta": 0.02}}
RAYLEIGH: dict[str, Any] = {"damping": {"kind": "rayleigh", "beta": 0.01, "alpha": 0.4, "drag": "space"}}
GRAVITY: dict[str, Any] = {"gravity": {"g": [0.7, -2.0], "hand_weight": True}}
CASES: dict[str, dict[str, Any]] = {
    "one_way": KV,
    "space_gravity": {**RAYLEIGH, **GRAVITY, "rotation": True},
    "two_way": {**KV, **GRAVITY, "reaction": True},
    "two_way_space": {**RAYLEIGH, **GRAVITY, "reaction": True, "rotation": True},
}
Q, R = 30.0, 0.5


@dataclass
class Setup:
    """A scene, its problem, its dense matrices in node order (written here, not by lqr) and the optimal gain."""

    model: Model
    problem: RiccatiProblem
    E: Array
    A: Array
    B: Array
    f: Array
    C: Array
    X: Array
    K: Array

    @property
    def gain(self) -> Gain:
        n_s, n_e, layout = self.problem.layout.n_s, self.problem.layout.n_e, self.problem.layout
        K_z, K_v = self.K[:, 2 * n_s : 2 * n_s + n_e], self.K[:, 2 * n_s + n_e :]
        return Gain(self.K[:, : 2 * n_s], local_rows(layout, K_z.T.copy()), local_rows(layout, K_v.T.copy()))

    @property
    def solution(self) -> RiccatiSolution:
        n_s, n_e, layout = self.problem.layout.n_s, self.problem.layout.n_e, self.problem.layout
        values, vectors = np.linalg.eigh(self.X)
        Z = vectors * np.sqrt(np.maximum(values, 0))
        parts = [local_rows(layout, Z[a : a + n_e].copy()) for a in (2 * n_s, 2 * n_s + n_e)]
        return RiccatiSolution(Block(Z[: 2 * n_s], np.concatenate(parts)), self.gain, 0.0, "dense")

    def full(self, x: PlantState) -> Array:
        z = gather_states(self.problem.layout, np.concatenate([x.z, x.v_z]))
        return np.concatenate([x.q_s, x.v_s, z])

    def recursion(self, x: Array, x_bar: Array, u_bar: Array, dt: float, steps: int) -> tuple[Array, Array]:
        """Midpoint rule of E x' = (A + B K) x + ..., the closed loop factored as one matrix."""
        closed, load = self.A + self.B @ self.K, self.f + self.B @ (u_bar - self.K @ x_bar)
        lu = scipy.linalg.lu_factor(self.E - dt / 2 * closed)
        X, U = [x], []
        for _ in range(steps):
            X.append(scipy.linalg.lu_solve(lu, (self.E + dt / 2 * closed) @ X[-1] + dt * load))
            U.append(u_bar + self.K @ ((X[-1] + X[-2]) / 2 - x_bar))
        return np.array(X), np.array(U)


def make_problem(model: Model) -> RiccatiProblem:
    system = model.system
    n, n_s = system.layout.n_local, system.layout.n_s
    outputs = make_outputs(model.scene, system)
    C_s = np.vstack([o.C_s for o in outputs])
    C_z, at = np.zeros((n, len(C_s)), order="F"), 0
    for o in outputs:
        for row in o.dofs:
            C_z[row, np.arange(at, at + o.size)] += o.weight
        at += o.size
    columns = tuple(OutputColumn(f"y{i}") for i in range(at))
    return RiccatiProblem(system, C_s, C_z, Q * np.eye(at), R * np.eye(n_s), columns)


@cache
def setup(case: str) -> Setup:
    control: dict[str, Any] = {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}
    if "rotation" in CASES[case]:
        control["outputs"].append({"kind": "hand"})
    model = build(make_scene(effects=CASES[case], control=control), comm=MPI.COMM_WORLD)
    problem = make_problem(model)
    system, layout = model.system, model.system.layout
    M, K = (gather_matrix(layout, a).toarray() for a in (system.M_ee, system.K_ee))
    G, C_z = gather_rows(layout, system.G), gather_rows(layout, problem.C_z)
    n_s, n, s = layout.n_s, layout.n_e, layout.n_s
    alpha = system.damping.alpha
    D = alpha * M + system.damping.beta * K
    space = alpha if system.damping.in_space else 0.0
    two = 1.0 if system.two_way else 0.0
    one, zero = np.eye, np.zeros
    E = scipy.linalg.block_diag(one(s), system.M_hand + two * system.M_rigid, one(n), M)
    E[2 * s + n :, s : 2 * s], E[s : 2 * s, 2 * s + n :] = G, two * G.T
    A = zero((2 * (s + n), 2 * (s + n)))
    A[:s, s : 2 * s], A[2 * s : 2 * s + n, 2 * s + n :] = one(s), one(n)
    A[2 * s + n :, 2 * s : 2 * s + n], A[2 * s + n :, 2 * s + n :] = -K, -D
    A[2 * s + n :, s : 2 * s] = -space * G
    A[s : 2 * s, s : 2 * s], A[s : 2 * s, 2 * s + n :] = -two * space * system.M_rigid, -two * space * G.T
    B = zero((len(E), s))
    B[s : 2 * s] = one(s)
    f = zero(len(E))
    if system.gravity is not None:
        f[2 * s + n :] = G @ system.gravity
        f[s : 2 * s] = (system.M_hand + two * system.M_rigid) @ system.gravity
    C = np.hstack([problem.C_s, 0 * problem.C_s, C_z.T, 0 * C_z.T])
    # SciPy solves the equation well only in coordinates in which the energy is |x|^2 / 2
    omega2, Phi = scipy.linalg.eigh(K, M)
    S = scipy.linalg.block_diag(one(2 * s), Phi / np.sqrt(omega2), Phi)
    L = scipy.linalg.block_diag(one(2 * s), np.sqrt(omega2)[:, None] * (Phi.T @ M), Phi.T)
    E_m, A_m, B_m, C_m = L @ E @ S, L @ A @ S, L @ B, C @ S
    inverse = np.linalg.inv(E_m)
    P = scipy.linalg.solve_continuous_are(inverse @ A_m, inverse @ B_m, Q * C_m.T @ C_m, R * one(n_s))
    X = L.T @ inverse.T @ P @ inverse @ L  # P = E'XE
    return Setup(model, problem, E, A, B, f, C, X, -(B.T @ X @ E) / R)


def aim(case: Setup) -> Array:
    return np.array([0.7, -0.4, 0.2])[: case.problem.layout.n_s]


def plain_loop(case: Setup, dt: float, steps: int, target: Any, law: Actuation) -> tuple[Array, Array]:
    """Sampled feedback by an explicit loop over dense solves; also the continuous one with limits, by bisection-free
    enumeration of which input sits where."""
    E, A, B, K = case.E, case.A, case.B, case.K
    x_bar, m = case.full(target.state), B.shape[1]
    bound = np.full(m, np.inf) if law.limits is None else np.broadcast_to(np.asarray(law.limits, float), (m,))
    lu = scipy.linalg.lu_factor(E - dt / 2 * A)
    x = case.full(rest(case.problem.system))
    X, U, every = [x], [], 0 if law.rate is None else round(1 / (law.rate * dt))
    queue = [np.clip(target.u, -bound, bound)]
    for n in range(steps):
        free = scipy.linalg.lu_solve(lu, E @ x + dt / 2 * case.f)
        if every:
            if n % every == 0:
                queue.append(np.clip(target.u + K @ (x - x_bar), -bound, bound))
            u = queue[-2 if law.delay else -1]
        else:
            Y = scipy.linalg.lu_solve(lu, dt / 2 * B)
            u = enumerate_input(target.u + K @ (free - x_bar), K @ Y, bound)
        mid = free + scipy.linalg.lu_solve(lu, dt / 2 * B @ u)
        x = 2 * mid - x
        X.append(x)
        U.append(u)
    return np.array(X), np.array(U)


def enumerate_input(u_0: Array, H: Array, bound: Array) -> Array:
    """u = clip(u_0 + H u) by trying every set of saturated inputs; exactly one fits."""
    m, found = len(u_0), []
    for code in range(3**m):
        side = np.array([code // 3**i % 3 - 1 for i in range(m)])
        free, u = side == 0, np.where(side == 0, 0.0, side * bound)
        if not np.isfinite(u).all():
            continue
        one = np.eye(m) - H
        if free.any():
            u[free] = np.linalg.solve(one[np.ix_(free, free)], u_0[free] + H[np.ix_(free, ~free)] @ u[~free])
        wish = u_0 + H @ u
        if (np.abs(wish[free]) <= bound[free]).all() and (side[~free] * wish[~free] > bound[~free]).all():
            found.append(u)
    assert len(found) == 1
    return found[0]
