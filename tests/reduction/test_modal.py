"""Conservative models mode by mode: against the plain midpoint rule, batches of prescribed hands, a new parameter."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import states_of
from softgrasp.reduction.online import run, run_batch
from softgrasp.reduction.projection import project
from softgrasp.reduction.propagator import propagator, turns
from softgrasp.reduction.system import EnergySystem, ModelError
from tests.helpers.models import Array, close, make_scene
from tests.helpers.reduced import DAMPED, KINDS, TINY, model_of, reduced, small_of, step_of, symplectic_basis, wiggle

FALL = {"effects": {"gravity": {"g": [1.0, -9.0]}}}
CANONICAL = [kind for kind in KINDS if kind[0] == "qp"]


def plain_driven(small: EnergySystem, dt: float, hand: tuple[Array, Array], y: Array) -> Array:
    """E_yy y' + E_ys [v_s; a_s] = A_yy y + A_ys [q_s; v_s] + f by the midpoint rule as it is written."""
    k, (q, v) = 2 * small.n_s, hand
    q = np.vstack([q[:1], q[0] + dt * np.cumsum((v[1:] + v[:-1]) / 2, axis=0)])
    s, states = np.hstack([q, v]), [y]
    for n in range(len(q) - 1):
        middle, rate = (s[n] + s[n + 1]) / 2, (s[n + 1] - s[n]) / dt
        load = small.A[k:, :k] @ middle - small.E[k:, :k] @ rate + small.f[k:]
        right = (small.E[k:, k:] + dt / 2 * small.A[k:, k:]) @ y + dt * load
        y = np.linalg.solve(small.E[k:, k:] - dt / 2 * small.A[k:, k:], right)
        states.append(y)
    return np.array(states)


def moving(steps: int, dt: float) -> tuple[Array, Array]:
    """A hand on a smooth way, (steps + 1, 2) each."""
    t = dt * np.arange(steps + 1)[:, None]
    return np.hstack([np.sin(2 * t), 1 - np.cos(3 * t)]), np.hstack([2 * np.cos(2 * t), 3 * np.sin(3 * t)])


@pytest.mark.parametrize("two_way", [False, True])
@pytest.mark.parametrize("kind", CANONICAL, ids=["-".join(map(str, kind[1:])) for kind in CANONICAL])
def test_modes_follow_the_plain_rule(comm: MPI.Intracomm, kind: tuple[Any, ...], two_way: bool) -> None:
    """Forced where the hand is inside the model, driven where it stands apart; also against the matrix of the steps."""
    small = small_of(model_of(comm, FALL, {"effects": {"reaction": two_way}}), kind)
    dt, steps, x0 = 0.013, 45, np.cos(np.arange(small.N))
    if kind[2]:
        hand = moving(steps, dt)
        own = run(small, dt, hand=hand, x0=x0)
        assert propagator(small, dt, driven=True).modal is not None
        assert close(own.x[:, 4:], plain_driven(small, dt, hand, x0[4:])) < 1e-10  # rounding over the frequencies
    if not kind[2] or two_way:
        step, u = propagator(small, dt), wiggle(steps, dt)
        assert step.modal is not None
        start = step.at.X_inverse @ x0
        blocks = replace(step, modal=None).march(u, start)
        assert close(step.march(u, start), blocks) < 1e-10  # as above


def test_turns_are_those_of_the_angles() -> None:
    angle = np.array([0.0, 1e-7, 0.3, 3.1])
    found = turns(angle, 100_000)
    assert found.shape == (100_001, 4)
    n = np.array([0, 1, 31, 32, 33, 99_999])
    assert np.abs(found[n] - np.exp(1j * np.outer(n, angle))).max() < 1e-10  # eps times the largest angle, 3e5
    assert np.abs(np.abs(found) - 1).max() < 1e-15  # a few roundings, however far


def test_damped_models_and_those_without_structure_keep_the_matrix(comm: MPI.Intracomm) -> None:
    model = model_of(comm, DAMPED)
    for kind in KINDS:
        assert propagator(small_of(model, kind), 0.01, driven=kind[2]).modal is None, kind
    for kind in KINDS:
        small = small_of(model_of(comm), kind)
        found = propagator(small, 0.01, driven=kind[2])
        assert (found.modal is not None) == (kind[0] == "qp"), kind


@pytest.mark.parametrize("damped", [False, True])
def test_batch_of_prescribed_hands_is_its_runs(comm: MPI.Intracomm, damped: bool) -> None:
    model = model_of(comm, *([DAMPED] if damped else []))
    rom = reduced(model, symplectic_basis(model.system.layout, 4, "relative", True))
    (m,) = model.system.materials
    many = [rom.at((replace(m, lam=lam, mu=mu),)) for lam, mu in ((30.0, 20.0), (50.0, 50.0), (500.0, 400.0))]
    dt = 0.01
    q, v = moving(21, dt)
    for single, whole in zip(many, run_batch(many, dt, hands=(q, v)), strict=True):
        alone = run(single, dt, hand=(q, v))
        assert close(alone.x, whole.x) < 1e-12  # the same products in another order
        assert close(alone.outputs, whole.outputs) < 1e-12  # as above
        assert (whole.q_s == q).all()
    hands = np.stack([q, 2 * q, -q]), np.stack([v, 2 * v, -v])
    for i, whole in enumerate(run_batch(many[:1], dt, hands=hands)):
        assert close(run(many[0], dt, hand=(hands[0][i], hands[1][i])).x, whole.x) < 1e-12  # as above
    with pytest.raises(ModelError, match="do not fit"):
        run_batch(many[:2], dt, hands=hands)
    with pytest.raises(ModelError, match="do not fit"):
        run_batch(many, dt, hands=(q, v[:-1]))
    with pytest.raises(ModelError, match="either"):
        run_batch(many, dt)


@pytest.mark.serial
def test_new_parameter_is_fast(comm: MPI.Intracomm) -> None:
    """N = 14, 600 steps, small matrices to outputs, 0.36 ms: no more than a few runs of the same model again."""
    scene = make_scene(TINY, {"output": {"snapshots": "memory"}, "time": {"steps": 600}})
    model = build(scene, comm=comm)
    full, dt = simulate(model), step_of(model)
    rom = project(make_basis("craig_bampton", states_of(model.system), 14), model.system)
    materials = tuple(replace(m, lam=77.0, mu=60.0) for m in model.system.materials)
    hand = (full.q_s, full.v_s)
    again = propagator(rom.at(materials), dt, driven=True)
    new, old = [], []
    for _ in range(60):
        begin = perf_counter()
        run(rom.at(materials), dt, hand=hand)
        middle = perf_counter()
        run(again, hand=hand)
        new.append(middle - begin)
        old.append(perf_counter() - middle)
    # both on one machine under one load: 3.1 mode by mode, 7.6 with the matrices of eight steps
    assert min(new) < 5 * min(old)
