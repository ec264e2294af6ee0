"""Bases for tests of reduced models: whole spaces, and smooth functions of the nodes that no rank count changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import total
from softgrasp.fem.run.motion import force_values
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory, run
from softgrasp.reduction.projection import project
from softgrasp.reduction.system import EnergySystem
from tests.helpers.models import Array, gather_rows, make_scene

KINDS = [(c, f, s) for c in ("qv", "qp") for f in ("absolute", "relative") for s in (True, False)]
"""Every kind of model: coordinates, frame, fixed solid modes."""
FORCED = {"motion": {"drive": "force"}, "output": {"snapshots": "memory"}}
DAMPED = {"effects": {"damping": {"kind": "rayleigh", "beta": 0.01, "alpha": 0.3, "drag": "space"}}}
TINY = {"tissue": {"cells": [2, 4]}, "time": {"steps": 30}}


def model_of(comm: MPI.Intracomm, *changes: dict[str, Any]) -> Model:
    """A small block whose hand is driven by a force."""
    return build(make_scene(TINY, FORCED, *changes), comm=comm)


def joined(
    layout: BlockLayout, q: Array, p: Array, hand: Array, coordinates: Any, frame: Any, fixed: bool, structure: Any
) -> Basis:
    """Basis of tissue blocks q, p; the hand's unit columns in front, or rows ``hand`` = [q_s; v_s or p_s]."""
    n_s, k = layout.n_s, 2 * layout.n_s
    if fixed:
        q, p = (np.asfortranarray(np.pad(X, ((0, 0), (k, 0)))) for X in (q, p))
        hand = np.eye(k, q.shape[1])
    return Basis("test", layout, hand[:n_s], hand[n_s:], q, p, coordinates, frame, structure, fixed)


def whole_basis(layout: BlockLayout, coordinates: Any, frame: Any, fixed: bool) -> Basis:
    """All unit vectors: [q_s, v_s | q, p] or [q_s, q | v_s, p]."""
    n_s, n_e = layout.n_s, layout.n_e
    one = np.eye(layout.n_local, n_e, layout.start)
    zero = np.zeros_like(one)
    if fixed:
        q, p = np.hstack([one, zero]), np.hstack([zero, one])
        return joined(layout, q, p, one, coordinates, frame, True, "none")
    n = n_s + n_e
    q, p = (np.asfortranarray(np.pad(one, ((0, 0), (at, 2 * n - at - n_e)))) for at in (n_s, n + n_s))
    hand = np.vstack([np.eye(n_s, 2 * n), np.eye(n_s, 2 * n, n)])
    return Basis("whole", layout, hand[:n_s], hand[n_s:], q, p, coordinates, frame, "none", False)


def waves(layout: BlockLayout, k: int, seed: int) -> Array:
    """k smooth displacement fields without symmetry, local rows."""
    d = layout.dimension
    rng = np.random.default_rng(seed)  # the same numbers on every rank
    columns = []
    for _ in range(k):
        direction, phase = rng.standard_normal((d, d)) * 2.5, rng.uniform(0, 6, d)
        columns.append(np.cos(layout.nodes @ direction + phase).ravel())
    return np.array(columns).T.reshape(layout.n_local, k)


def symplectic_basis(
    layout: BlockLayout, pairs: int, frame: Any, fixed: bool, coordinates: Any = "qp", lift: bool = False
) -> Basis:
    """V = [Re C, -Im C; Im C, Re C] with C* C = I; ``lift`` takes Im C = 0."""
    n_s, root = layout.n_s, layout.comm.rank == 0
    real, imaginary = waves(layout, pairs, 1), 0.0 if lift else 0.4 * waves(layout, pairs, 2)
    C = real + 1j * imaginary
    rng = np.random.default_rng(3)
    hand = rng.standard_normal((n_s, pairs)) + (0 if lift else 0.4j * rng.standard_normal((n_s, pairs)))
    if fixed:
        hand = np.zeros_like(hand)
    local = C.conj().T @ C + (hand.conj().T @ hand if root else 0)
    gram = total(layout.comm, local.real) + 1j * total(layout.comm, local.imag)
    change = np.linalg.inv(np.linalg.cholesky(gram).conj().T)
    C, hand = C @ change, hand @ change
    q, p = np.hstack([C.real, -C.imag]), np.hstack([C.imag, C.real])
    rows = np.vstack([np.hstack([hand.real, -hand.imag]), np.hstack([hand.imag, hand.real])])
    structure = "symplectic" if coordinates == "qp" else ("second_order" if lift else "none")
    return joined(layout, np.asfortranarray(q), np.asfortranarray(p), rows, coordinates, frame, fixed, structure)


def leading(basis: Basis, pairs: int) -> Basis:
    """The hand's columns and the first pairs of a basis whose second half starts in the middle."""
    hand = 2 * basis.layout.n_s if basis.fixed_solid else 0
    half = (basis.N - hand) // 2
    pick = [*range(hand + pairs), *range(hand + half, hand + half + pairs)]
    blocks = {key: np.asfortranarray(getattr(basis, key)[:, pick]) for key in ("V_sq", "V_sv", "V_q", "V_p")}
    return replace(basis, **blocks)


def reduced(model: Model, basis: Basis) -> ReducedModel:
    """Project with the scene's outputs."""
    return project(basis, model.system, make_outputs(model.scene, model.system), "hash")


def force_of(model: Model) -> Array:
    """The scene's force on the hand."""
    return force_values(model.scene, model.system.layout.n_s, model.system.M_hand)


def step_of(model: Model) -> float:
    """The scene's time step."""
    return model.scene.time_end / model.scene.time.steps


def full_and_reduced(model: Model, basis: Basis) -> tuple[Trajectory, ReducedTrajectory, ReducedModel]:
    """Both runs for the scene's force."""
    rom = reduced(model, basis)
    return simulate(model), run(rom.at(), step_of(model), force_of(model), allow_unstable=True), rom


def distance(system: BlockSystem, a: Array, b: Array) -> float:
    """|a - b|_F / |b|_F of local rows."""
    sums = total(system.layout.comm, np.array([np.sum((a - b) ** 2), np.sum(b**2)]))
    return float(np.sqrt(sums[0] / sums[1]))


def small_of(model: Any, kind: tuple[Any, ...] = ("qp", "relative", True), pairs: int = 4) -> EnergySystem:
    """Small model of a symplectic basis of one kind."""
    coordinates, frame, fixed = kind
    rom = reduced(model, symplectic_basis(model.system.layout, pairs, frame, fixed, coordinates))
    assert rom.at().hand_first == rom.fixed_solid
    return rom.at()


def wiggle(steps: int, dt: float) -> Array:
    """A force on a hand with two freedoms, (steps, 2)."""
    t = dt * (np.arange(steps) + 0.5)
    return np.stack([40 * np.cos(1.5 * t), 20 * np.cos(2.2 * t + 0.4)], axis=1)


def dense_columns(model: Any, basis: Basis) -> Array:
    """V in the rows [q_s, q_e, v_s, v_e] of :func:`tests.helpers.first_order`."""
    layout = model.system.layout
    rows = [basis.V_sq, gather_rows(layout, basis.V_q), basis.V_sv, gather_rows(layout, basis.V_p)]
    return np.concatenate(rows)
