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

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.reduced import MidpointSteps
from softgrasp.fem.run.motion import force_values, free_table
from softgrasp.fem.solve.stiffness import factored_stiffness
from softgrasp.fem.system import BlockSystem

BLOCKS = 4
DROPPED = 1e-12  # of the squared length before the projection: directions that are rounding only, or known already

Solve = Callable[[Array], Array]


@dataclass(frozen=True)
class KrylovModel:
    """M xi'' + D xi' + K xi = G c, z = V xi, of a model; small arrays on every rank."""

    V: Array  # basis, local rows (n_local, N), with V' K V = 1
    M: Array  # projected mass V' M_ee V, (N, N)
    D: Array  # projected damping V' D_ee V, (N, N)
    G: Array  # projected coupling V' G, (N, n_s)
    C: Array  # outputs of the deformation, C_z' V, (p, N)
    C_s: Array  # outputs of the rigid motion, (p, n_s)
    # static solutions K_ee^-1 [G, C'], local rows (n_local, n_s + p); columns of outputs that are none are zero
    X: Array
    model: Model  # full model

    @cached_property
    def run(self) -> KrylovRun:
        """The run of the scene, see :func:`run_krylov`."""
        return run_krylov(self)

    @cached_property
    def modes(self) -> tuple[Array, Array]:
        """Ritz frequencies omega (N,), ascending [1/s], and modes (N, N) with Phi' M Phi = 1."""
        squares, Phi = np.linalg.eigh(self.M)  # 1 / omega^2: V'K V is the identity
        omega = 1 / np.sqrt(squares[::-1])
        return omega, Phi[:, ::-1] * omega


@contextmanager
def static_solves(model: Model) -> Iterator[Solve]:
    """Function X -> K_ee^-1 X on local rows, factored once. Collective."""
    with factored_stiffness(model.system, rtol=1e-10) as solver:
        yield solver.columns


def krylov_model(model: Model) -> KrylovModel:
    """The small model of a model, with `BLOCKS` static solves of each column. Collective.

    A mesh with fewer unknowns than columns ends in a basis of its whole space, where the small model is the full one.
    """
    system = model.system
    C = output_columns(make_outputs(model.scene, system), system.layout.n_local)
    V = K_V = np.zeros((len(C), 0))
    with static_solves(model) as solve:
        last = X = solve(np.hstack([system.G, C]))
        for k in range(BLOCKS):
            if k:
                last = solve(times_columns(system.M_ee, last))
            V, K_V, last = extended(system, V, K_V, last)
    return projected(model, V, X)


def extended(system: BlockSystem, V: Array, K_V: Array, block: Array) -> tuple[Array, Array, Array]:
    """V and K V with the directions that a block adds, V' K V = 1, and these directions. Collective."""
    comm = system.layout.comm
    for _ in range(2):  # once is not enough where blocks are nearly dependent
        K_block = times_columns(system.K_ee, block)
        lengths = total(comm, np.einsum("ij,ij->j", block, K_block))
        known = total(comm, V.T @ K_block)
        block, K_block = block - V @ known, K_block - K_V @ known
        gram = total(comm, block.T @ K_block)
        scale = np.sqrt(np.maximum(lengths, 1e-300))
        Q = comm.bcast(normalising((gram + gram.T) / 2 / np.outer(scale, scale), 0.0, DROPPED) / scale[:, None])
        block, K_block = block @ Q, K_block @ Q
    return np.hstack([V, block]), np.hstack([K_V, K_block]), block


def projected(model: Model, V: Array, X: Array) -> KrylovModel:
    """The model on a basis V with V' K V = 1, with its static solutions X, local rows. Collective."""
    system, comm = model.system, model.system.layout.comm
    outputs = make_outputs(model.scene, system)
    C = output_columns(outputs, system.layout.n_local)
    damping = system.damping
    M = total(comm, V.T @ times_columns(system.M_ee, V))
    D = damping.alpha * M + damping.beta * np.eye(len(M))
    if damping.matrix is not None:
        D = damping.alpha * M + total(comm, V.T @ times_columns(damping.matrix, V))
    C_s = np.vstack([o.C_s for o in outputs])
    pair = total(comm, V.T @ np.hstack([system.G, C]))
    n_s = system.layout.n_s
    return KrylovModel(V, (M + M.T) / 2, (D + D.T) / 2, pair[:, :n_s], pair[:, n_s:].T, C_s, X, model)


@dataclass(frozen=True)
class KrylovRun:
    """A run of a small model."""

    deformation: Array  # outputs against the hand, (steps + 1, p)
    rigid: Array  # their rigid part, (steps + 1, p)
    loads: Array  # c of each step, (steps, n_s)
    accelerations: Array  # xi'' at the middle of each step, (steps, N)


def run_krylov(small: KrylovModel, steps: int | None = None) -> KrylovRun:
    """Run the scene's motion or force with the midpoint rule, as the full model does.

    Raises SceneError: a CSV file of the motion does not fit.
    """
    system, scene = small.model.system, small.model.scene
    n = steps or scene.time.steps
    scene = scene.model_copy(update={"time": scene.time.model_copy(update={"steps": n})})
    dt, g, alpha = scene.time_end / n, system.fall, system.damping.drag
    z = small.G @ g if scene.time.start == "equilibrium" else np.zeros(len(small.M))  # V' K V = 1
    if scene.motion.drive == "force" and system.two_way:  # hand and tissue together
        G, R, n_s = small.G, system.M_rigid, len(g)
        M = np.block([[system.M_hand + R, G.T], [G, small.M]])
        D = np.block([[alpha * R, alpha * G.T], [alpha * G, small.D]])
        K = np.diag(np.repeat([0.0, 1.0], [n_s, len(z)]))
        B, fall = np.eye(len(M), n_s), np.vstack([R, G]) @ g
        u = force_values(scene, n_s, system.M_hand) + system.weight
        X, a = _midpoint(M, D, K, B, fall, u, np.append(np.zeros(n_s), z), dt)
        q, Z, accelerations = X[:, :n_s], X[:, n_s:], a[:, n_s:]
        loads = g - a[:, :n_s] - alpha * np.diff(q, axis=0) / dt
    else:
        table, _ = free_table(system, scene, dt)
        q, loads = table.q, g - table.a - alpha * (table.v[1:] + table.v[:-1]) / 2
        Z, accelerations = _midpoint(small.M, small.D, np.eye(len(z)), small.G, 0 * z, loads, z, dt)
    return KrylovRun(Z @ small.C.T, q @ small.C_s.T, loads, accelerations)


def _midpoint(
    M: Array, D: Array, K: Array, B: Array, f: Array, inputs: Array, x: Array, dt: float
) -> tuple[Array, Array]:
    """M x'' + D x' + K x = B u + f from rest at x for inputs u at the midpoints: x (n + 1, N) and x'' (n, N)."""
    N, one = len(x), np.eye(len(x))
    E, A = np.block([[one, 0 * one], [0 * one, M]]), np.block([[0 * one, one], [-K, -D]])
    loads = np.vstack([np.zeros((N, B.shape[1] + 1)), np.column_stack([B, f])])
    w = MidpointSteps(dt, E, A, loads).march(inputs, np.append(x, np.zeros(N)))
    return w[:, :N], np.diff(w[:, N:], axis=0) / dt
