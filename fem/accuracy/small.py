"""A small model from static solves that follows the outputs of a scene's own run.

    V = span{X, K^-1 M X, (K^-1 M)^2 X, ..},   X = K_ee^-1 [G, C'],

matches the moments of C (K + s^2 M)^-1 G about s = 0 [B02], twice as many as it has blocks because both sides are in X.
What is driven slower than the first neglected frequency it follows to the accuracy of the static solves, which is what
the difference between two meshes needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import Output, make_outputs
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.run.motion import force_values, free_table
from softgrasp.fem.solve.solvers import choose_solver, make_solver

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

BLOCKS = 4
DROPPED = 1e-12  # of the largest squared length in a block: directions that are rounding only
PREFIX = "softgrasp_accuracy_"

Solve = Callable[[Array], Array]


@dataclass(frozen=True)
class Small:
    """M xi'' + D xi' + K xi = G c, z = V xi, of a model; small arrays on every rank."""

    V: Array  # basis, local rows (n_local, N), with V' K V = 1
    # M, D: projected mass and damping (N, N)
    M: Array
    D: Array
    G: Array  # coupling (N, n_s)
    C: Array  # outputs of the tissue against the hand (p, N)
    C_s: Array  # their rigid part (p, n_s)
    # static solutions K_ee^-1 [G, C'], local rows (n_local, n_s + p); columns of outputs that are none are zero
    X: Array
    model: Model  # whose it is

    @cached_property
    def run(self) -> SmallRun:
        """The run of the scene, see :func:`run_small`."""
        return run_small(self)

    @cached_property
    def modes(self) -> tuple[Array, Array]:
        """Ritz frequencies omega (N,), ascending [1/s], and modes (N, N) with Phi' M Phi = 1."""
        squares, Phi = scipy.linalg.eigh(np.eye(len(self.M)), self.M)
        return np.sqrt(squares), Phi


def output_columns(outputs: tuple[Output, ...], n_local: int) -> Array:
    """C' of all outputs, local rows (n_local, p)."""
    columns = []
    for output in outputs:
        for c in range(output.size):
            column = np.zeros(n_local)
            if len(output.dofs):
                column[output.dofs[:, c]] = output.weight
            columns.append(column)
    return np.asfortranarray(np.array(columns).reshape(len(columns), n_local).T)


@contextmanager
def static_solves(model: Model) -> Iterator[Solve]:
    """What applies K_ee^-1 to columns, factored once. Collective."""
    system, time = model.system, model.scene.time
    name, _ = choose_solver(system.layout, "auto", few=True)
    solver = make_solver(system.K_ee.copy(), name, system.layout, PREFIX, min(time.rtol, 1e-10), reproducible=False)
    try:
        yield solver.columns
    finally:
        solver.destroy()


def reduced(model: Model) -> Small:
    """The small model of a model, with `BLOCKS` static solves of each column. Collective."""
    system, comm = model.system, model.system.layout.comm
    outputs = make_outputs(model.scene, system)
    C = output_columns(outputs, system.layout.n_local)
    V = K_V = np.zeros((len(C), 0))
    with static_solves(model) as solve:
        last = X = solve(np.hstack([system.G, C]))
        for k in range(BLOCKS):
            if k:
                last = solve(times_columns(system.M_ee, last))
            for _ in range(2):  # once is not enough where blocks are nearly dependent
                K_last = times_columns(system.K_ee, last)
                known = total(comm, V.T @ K_last)
                last, K_last = last - V @ known, K_last - K_V @ known
                gram = total(comm, last.T @ K_last)
                scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
                squares, Q = np.linalg.eigh((gram + gram.T) / 2 / np.outer(scale, scale))
                kept = squares > DROPPED
                Q = comm.bcast((Q[:, kept] / np.sqrt(squares[kept])) / scale[:, None])
                last, K_last = last @ Q, K_last @ Q
            V, K_V = np.hstack([V, last]), np.hstack([K_V, K_last])
    damping = system.damping
    M = total(comm, V.T @ times_columns(system.M_ee, V))
    D = damping.alpha * M + damping.beta * np.eye(len(M))
    if damping.matrix is not None:
        D = damping.alpha * M + total(comm, V.T @ times_columns(damping.matrix, V))
    C_s = np.vstack([o.C_s for o in outputs])
    pair = total(comm, V.T @ np.hstack([system.G, C]))
    n_s = system.layout.n_s
    return Small(V, (M + M.T) / 2, (D + D.T) / 2, pair[:, :n_s], pair[:, n_s:].T, C_s, X, model)


@dataclass(frozen=True)
class SmallRun:
    """A run of a small model."""

    deformation: Array  # outputs against the hand, (steps + 1, p)
    rigid: Array  # their rigid part, (steps + 1, p)
    loads: Array  # c of each step, (steps, n_s)
    accelerations: Array  # xi'' at the middle of each step, (steps, N)


def run_small(small: Small, steps: int | None = None) -> SmallRun:
    """Run the scene's motion or force with the midpoint rule, as the full model does.

    Raises SceneError: a CSV file of the motion does not fit.
    """
    system, scene = small.model.system, small.model.scene
    n = steps or scene.time.steps
    scene = scene.model_copy(update={"time": scene.time.model_copy(update={"steps": n})})
    dt = scene.time_end / n
    z = small.G @ system.fall if scene.time.start == "equilibrium" else np.zeros(len(small.M))  # V' K V = 1
    if scene.motion.drive == "force" and system.two_way:
        return _driven(small, scene, z, dt)
    table, _ = free_table(system, scene, dt)
    loads = system.fall - table.a - system.damping.drag * (table.v[1:] + table.v[:-1]) / 2
    s = 2 / dt
    inverse = np.linalg.inv(np.eye(len(z)) + s * small.D + s * s * small.M)
    half = np.hstack([-inverse, s * s * inverse @ small.M])  # w = z_mid - z_n from z_n and u_n = v_n / s
    T = np.vstack([2 * half, 2 * half]) + np.diag(np.repeat([1.0, -1.0], len(z)))  # u_{n+1} = 2 w - u_n
    Y = np.empty((n + 1, 2 * len(z)))
    Y[0, : len(z)], Y[0, len(z) :] = z, 0.0
    Y[1:] = np.tile(2 * loads @ (inverse @ small.G).T, 2)
    for i in range(n):
        Y[i + 1] += T @ Y[i]
    u = Y[:, len(z) :]
    return SmallRun(Y[:, : len(z)] @ small.C.T, table.q @ small.C_s.T, loads, s * s * np.diff(u, axis=0) / 2)


def _driven(small: Small, scene: Scene, z: Array, dt: float) -> SmallRun:
    """Hand and tissue together, as in :class:`softgrasp.fem.run.motion.ForceDrive`."""
    system, s, n_s = small.model.system, 2 / dt, small.G.shape[1]
    u = force_values(scene, n_s, system.M_hand) + system.weight
    g, alpha = system.fall, system.damping.drag
    kappa, theta = 1 + alpha * dt / 2, s * s + alpha * s
    inverse = np.linalg.inv(np.eye(len(z)) + s * small.D + s * s * small.M)
    Y = inverse @ small.G
    hand = np.linalg.inv(system.M_hand + kappa * (system.M_rigid - theta * small.G.T @ Y))
    n = len(u)
    q, vs, v = np.zeros((n + 1, n_s)), np.zeros(n_s), np.zeros_like(z)
    Z, loads, a = np.empty((n + 1, len(z))), np.empty((n, n_s)), np.empty((n, len(z)))
    Z[0] = z
    for i in range(n):
        c0 = alpha * vs - g
        x = inverse @ (s * (small.M @ v) - Z[i])
        pull = small.G.T @ (theta * (x - Y @ c0) - s * v)
        push = hand @ (u[i] - system.M_rigid @ c0 - pull)
        loads[i] = -(kappa * push + c0)
        w = x + Y @ loads[i]
        a[i] = s * (s * w - v)
        Z[i + 1], v = Z[i] + 2 * w, 2 * s * w - v
        q[i + 1] = q[i] + dt * (vs + dt * push / 2)
        vs = vs + dt * push
    return SmallRun(Z @ small.C.T, q @ small.C_s.T, loads, a)
