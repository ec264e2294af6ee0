"""The force on the hand: given, or what the motion takes, against dense algebra and against the force that made it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import HandTable, TableDrive, force_values
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.run.stepping import make_ts
from tests.fem.run.test_midpoint import DRAGGED, GRAVITY, LAYERED, RAYLEIGH, SAME_RUN, TINY, VISCOUS
from tests.helpers.models import CUBE, absolute, close, first_order, make_scene, reference, same_everywhere, wave

pytestmark = pytest.mark.ranks
IN_SPACE: dict[str, Any] = {"effects": {"gravity": {"g": [0.5, 0.2, -9.0], "hand_weight": True}}}
CASES: dict[str, list[dict[str, Any]]] = {
    "bare": [],
    "viscous": [{"effects": VISCOUS}],
    "relative": [{"effects": RAYLEIGH}],
    "dragged, weighing": [{"effects": DRAGGED | GRAVITY}],
    "equilibrium": [{"effects": VISCOUS | GRAVITY, "time": {"start": "equilibrium"}}],
    "layers": [LAYERED, {"effects": DRAGGED | GRAVITY}],
    "p2": [TINY, {"tissue": {"order": 2}, "effects": VISCOUS}],
    "3d": [CUBE, {"hand": {"inertia": [1.0, 2.0, 3.0]}}],
    "3d, dragged, weighing": [CUBE, {"hand": {"inertia": [1.0, 2.0, 3.0]}, "effects": DRAGGED}, IN_SPACE],
}


def led(model: Model, hand: Trajectory) -> Trajectory:
    """The run of a hand that is led exactly as it went in another run. Collective."""
    run = Run(model, RunOptions())
    dt = hand.times[1] - hand.times[0]
    run.drive = TableDrive(model.system, HandTable(hand.q_s, hand.v_s, np.diff(hand.v_s, axis=0) / dt))
    ts = make_ts(run)
    run.start()
    run.take(ts, run.steps)
    ts.destroy()
    return run.trajectory()


def pushed(
    comm: MPI.Intracomm, *changes: dict[str, Any], strength: float = 1.0, **effects: Any
) -> tuple[Trajectory, Trajectory, Array]:
    """A two-way run under a force, the one-way run of the same motion, and the force. Collective."""
    two, one = (build(make_scene(*changes, {"effects": effects | {"reaction": r}}), comm=comm) for r in (True, False))
    run = simulate(two, force=lambda n, t, q, v: strength * wave(n, t, q, v))
    n_s, dt = run.q_s.shape[1], run.times[1]
    u = [strength * wave(n, (n + 0.5) * dt, np.zeros(n_s), np.zeros(n_s)) for n in range(len(run.times) - 1)]
    return run, led(one, run), np.array(u)


@pytest.mark.ranks(rotation=True, name=("equilibrium", "layers", "p2", "3d, dragged, weighing"))
@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_a_motion_takes_the_force_that_made_it(comm: MPI.Intracomm, name: str, rotation: bool) -> None:
    run, again, u = pushed(comm, *CASES[name], rotation=rotation)
    np.testing.assert_array_equal(run.force, u)
    assert again.force.shape == u.shape == (len(run.times) - 1, run.q_s.shape[1])
    assert close(again.outputs, run.outputs) < SAME_RUN
    assert close(again.force, u) < SAME_RUN
    assert same_everywhere(comm, again.force)


@pytest.mark.ranks(name=("dragged, weighing", "3d"))
@pytest.mark.parametrize("name", ["bare", "viscous", "relative", "dragged, weighing", "3d"])
def test_the_force_is_known_at_finite_strain(comm: MPI.Intracomm, name: str) -> None:
    """Steps to a tolerance of 1e-12; their first solutions part by what is left of a residual."""
    law = {"law": "neo-hooke", "tol": 1e-12}
    _, again, u = pushed(comm, *CASES[name], strength=3.0, finite_strain=law)
    assert again.newton is not None
    assert again.newton.min_det < 0.97  # it is not a small deformation
    assert close(again.force, u) < SAME_RUN


@pytest.mark.ranks(reaction=True)
@pytest.mark.parametrize("reaction", [False, True])
@pytest.mark.parametrize("damping", [{}, RAYLEIGH, DRAGGED], ids=["undamped", "rayleigh", "dragged"])
def test_force_that_a_prescribed_motion_takes(comm: MPI.Intracomm, damping: dict[str, Any], reaction: bool) -> None:
    """The hand's row of the dense two-way system; without gravity its impulse is the momentum of hand and tissue."""
    weight = {} if not damping else GRAVITY
    effects = damping | weight | {"rotation": True}
    motion = {"motion": {"target": [5.0, 3.0, 0.2]}}
    model = build(make_scene(motion, effects=effects | {"reaction": reaction}), comm=comm)
    run = simulate(model)
    ref = reference(build(make_scene(motion, effects=effects | {"reaction": True}), comm=comm))
    full, n_s = first_order(ref), 3
    X, dt = absolute(model, run.q_s.T, run.v_s.T, run.snapshots.Z), 3.0 / 60
    rows = slice(len(X) // 2, len(X) // 2 + n_s)
    u = full.E[rows] @ np.diff(X) / dt - full.A[rows] @ (X[:, 1:] + X[:, :-1]) / 2 - full.f[rows, None]
    assert close(run.force, u.T) < SAME_RUN
    if not damping:
        momentum = ref.M_hand @ run.v_s[-1] + ref.R.T @ ref.M @ ref.P @ X[len(X) // 2 :, -1]
        assert close(run.force.sum(axis=0) * dt, momentum) < SAME_RUN


@pytest.mark.parametrize("reaction", [False, True])
def test_an_applied_force_is_kept(comm: MPI.Intracomm, reaction: bool) -> None:
    effects = DRAGGED | GRAVITY | {"reaction": reaction}
    model = build(make_scene(motion={"drive": "force"}, effects=effects), comm=comm)
    np.testing.assert_array_equal(simulate(model).force, force_values(model.scene, 2, model.system.M_hand))
