"""Snapshots of one small run, gathered in node order, and bases as dense matrices: the ground for tests of bases."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.bases.inner import InnerName, Rows
from softgrasp.reduction.bases.registry import METHODS
from softgrasp.reduction.bases.states import States, states_of
from tests.helpers.models import Array, gather_matrix, gather_rows, make_scene

SNAPSHOT_METHODS = [key for key, method in METHODS.items() if method.snapshots]
ORTHONORMAL = [key for key in SNAPSHOT_METHODS if "svd_like" not in key]
CANONICAL = [key for key, method in METHODS.items() if method.structure == "symplectic"]


@dataclass(frozen=True)
class Case:
    """One run, and the same in node order on every rank."""

    model: Model
    states: States
    snapshots: Snapshots
    M: Array
    K: Array
    T: Array
    G: Array
    z: Array
    v: Array

    @property
    def n(self) -> int:
        return self.model.system.layout.n_e


@cache
def case(two_way: bool = False) -> Case:
    """40 snapshots of a small block with more than 80 unknowns, so that SLEPc factors all stacks. Collective."""
    tissue = {"cells": [5, 10], "material": {"lambda": 50.0, "mu": 30.0, "rho": 1.3}}
    effects = {"reaction": two_way}
    scene = make_scene(tissue=tissue, effects=effects, time={"steps": 156}, output={"every": 4})
    model = build(scene, comm=MPI.COMM_WORLD)
    assert model.system.layout.n_e > 80
    run = simulate(model)
    assert run.snapshots is not None
    system, s = model.system, run.snapshots
    n = system.layout.n_local
    gathered = [gather_rows(system.layout, x) for x in (system.T, system.G, s.Z[:n], s.Z[n:])]
    M, K = (gather_matrix(system.layout, A).toarray() for A in (system.M_ee, system.K_ee))
    return Case(model, states_of(system, s), s, M, K, *gathered)


def dense(basis: Basis) -> Array:
    """V in node order on every rank, rows [q_s; v_s; q_e; v_e]. Collective."""
    rows = [gather_rows(basis.layout, x) for x in (basis.V_q, basis.V_p)]
    return np.vstack([basis.V_sq, basis.V_sv, *rows])


def snapshot_rows(c: Case, coordinates: str, frame: str) -> tuple[Array, Array, Array, Array]:
    """Hand and tissue rows by the formulas of the paper, with M_es = G - M T."""
    q_s, v_s = c.snapshots.q_s, c.snapshots.v_s
    z, v = (c.z, c.v) if frame == "relative" else (c.z + c.T @ q_s, c.v + c.T @ v_s)
    if coordinates == "qv":
        return q_s, v_s, z, v
    p_s = c.model.system.M_hand @ v_s
    return q_s, p_s, z, c.M @ v + (0 if frame == "relative" else (c.G - c.M @ c.T) @ v_s)


def halves(c: Case, key: str) -> tuple[Array, Array]:
    """Snapshots (q; p) with the hand's rows on top where they take part."""
    method = METHODS[key]
    s_q, s_p, e_q, e_p = snapshot_rows(c, method.coordinates, method.frame)
    return (e_q, e_p) if method.fixed else (np.vstack([s_q, e_q]), np.vstack([s_p, e_p]))


def basis_halves(basis: Basis) -> tuple[Array, Array]:
    """Rows (q; p) of V, without hand columns and rows where the hand is kept apart."""
    V, n_s = dense(basis), basis.layout.n_s
    first = 2 * n_s if basis.fixed_solid else 0
    n = basis.layout.n_e
    q, p = V[2 * n_s : 2 * n_s + n, first:], V[2 * n_s + n :, first:]
    if basis.fixed_solid:
        return q, p
    return np.vstack([V[:n_s], q]), np.vstack([V[n_s : 2 * n_s], p])


def root_of(c: Case, key: str, inner: InnerName, half: int) -> Array:
    """L with L L' = weight of one half in (q, v)."""
    system, fixed = c.model.system, METHODS[key].fixed
    if inner == "euclidean":
        return np.eye(c.n + (0 if fixed else system.layout.n_s))
    stiff = inner == "energy" and half == 0
    tissue = c.K if stiff else c.M
    hand = c.T.T @ c.K @ c.T if stiff else system.M_hand
    return np.linalg.cholesky(tissue if fixed else scipy.linalg.block_diag(hand, tissue))


def gap(A: Array, B: Array) -> float:
    """Sine of the largest angle between two subspaces of one dimension."""
    Q_A, Q_B = np.linalg.qr(A)[0], np.linalg.qr(B)[0]
    return float(np.linalg.norm(Q_A - Q_B @ (Q_B.T @ Q_A), 2))


def symplecticity(basis: Basis) -> float:
    """Largest entry of V' J V - J, with the tissue's columns alone when the solid modes are fixed. Collective.

    J = [0 I; -I 0] on the rows (q; p) and on the columns (first half; second half).
    """
    rows = Rows(basis.layout, hand=True)
    first = 2 * basis.layout.n_s if basis.fixed_solid else 0
    q = rows.stack(basis.V_sq, basis.V_q)[:, first:]
    p = rows.stack(basis.V_sv, basis.V_p)[:, first:]
    form = rows.gram(q, p)
    k = form.shape[0] // 2
    J = np.eye(2 * k, k=k) - np.eye(2 * k, k=-k)
    return float(np.abs(form - form.T - J).max(initial=0.0))
