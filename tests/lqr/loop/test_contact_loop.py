"""Feedback that was designed without obstacles drives the full plant into one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import to_scipy, total
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.full import LoopOptions
from softgrasp.lqr.plant.checks import ControlError

SCENE = ["tissue.cells=[4, 8]", "effects.reaction=true", "motion.target=[2.0, -1.0]"]
RUN = ["motion.drive='force'", "time={steps=2000, end=40}"]
FLOOR = ["effects.obstacles=true", "obstacle=[{kind='halfspace', normal=[0, 1], offset=-0.95}]"]


@pytest.mark.serial
def test_a_loop_rests_on_the_obstacle_that_its_design_does_not_know() -> None:
    controller = sg.make_controller(sg.design(sg.build("paper_lqr", [*SCENE, "control.loop.rate=50"])), order=8)
    runs = []
    for more in ([], FLOOR):
        controller.reset()
        model = sg.build("paper_lqr", [*SCENE, *RUN, *more])
        runs.append(sg.simulate(model, force=lambda n, t, q, v: controller.step(q, v)))
    free, stopped = runs
    assert free.q_s[-1] == pytest.approx([2.0, -1.0], abs=0.03)  # what is left after 40 s
    assert -0.96 < stopped.q_s[-1, 1] < -0.95 + 0.01  # on the floor, pressed into it by less than a centimetre
    contact = stopped.contact
    assert contact is not None
    assert contact.force[-500:, 0, 1].mean() > 0.01  # the loop pushes on: it misses its target
    assert contact.penetration < 1e-12
    assert stopped.energy_drift < 1e-12
    # momentum: what hand and floor give, less what moves; the tissue is 2 of 22 kg and moves with the hand
    mass, dt = model.system.M_hand[1, 1] + model.system.M_rigid[1, 1], 0.02
    given = dt * (stopped.force[:, 1] + contact.force[:, 0, 1]).sum()
    tissue = float(np.asarray(model.system.G[:, 1] @ np.split(stopped.final, 2)[1]))
    assert given == pytest.approx(mass * stopped.v_s[-1, 1] + tissue, abs=1e-10)  # rounding of 2000 steps


def touching_loop(
    *more: str, dt: float = 0.2, steps: int = 125, comm: MPI.Intracomm = MPI.COMM_WORLD, **law: Any
) -> Any:
    """Design, a run without and one with the obstacles of the scene. Collective."""
    model = sg.build("paper_lqr", [*SCENE, FLOOR[0], *(more or FLOOR[1:])], comm=comm)
    found = sg.design(model)
    loop = sg.ClosedLoop(found.problem, dt, scene=model)
    runs = [
        loop.run(found.gain, found.target, steps, Actuation(**law), options=LoopOptions("memory", touching=touching))
        for touching in (False, True)
    ]
    loop.destroy()
    return found, *runs


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("limit", "friction"), [(None, 0.3), (0.9, 0.0)])
def test_the_law_and_contact_hold_together(limit: float | None, friction: float) -> None:
    """u = clip(u_bar + K (x_mid - x_bar)) from the stored states, in every step, also where obstacles press."""
    floor = f"obstacle=[{{kind='halfspace', normal=[0, 1], offset=-0.95, friction={friction}}}]"
    found, free, run = touching_loop(floor, limits=limit)
    gain, target, states, contact = found.gain, found.target, run.snapshots.Z, run.contact
    n = len(gain.K_z)
    mid = (states[:, 1:] + states[:, :-1]) / 2
    hand = np.hstack([run.q_s, run.v_s])
    rest = gain.K_s @ np.concatenate([target.state.q_s, target.state.v_s])
    seen = gain.K_z.T @ (mid[:n] - target.state.z[:, None]) + gain.K_v.T @ mid[n:]
    u = target.u + (hand[1:] + hand[:-1]) / 2 @ gain.K_s.T - rest + total(MPI.COMM_WORLD, seen).T
    u = u if limit is None else np.clip(u, -limit, limit)
    smooth = ~contact.impulse.any(axis=(1, 2))  # an impulse jumps after the midpoint
    pressed = contact.touching[:, 0] > 0
    assert (smooth & pressed).sum() > 5
    assert np.abs(run.inputs - u)[smooth].max() < 1e-8 * np.abs(u).max()  # rounds end at 1e-11 of the parts of K x
    assert np.abs(free.inputs - u)[pressed].max() > 1e-3
    assert contact.penetration < 1e-13
    assert (run.saturated > 0) == (limit is not None)
    assert run.energy_drift < 1e-12


@pytest.mark.ranks
@pytest.mark.parametrize("law", [{}, {"rate": 5.0, "delay": 1}], ids=["continuous", "held"])
def test_ranks_agree_and_an_obstacle_out_of_reach_changes_no_bit(law: dict[str, Any]) -> None:
    _, _, run = touching_loop(**law)
    _, _, alone = touching_loop(**law, comm=MPI.COMM_SELF)
    assert run.q_s == pytest.approx(alone.q_s, abs=1e-9)  # of 2 m: rounding over 125 steps and some impacts
    assert run.contact.force == pytest.approx(alone.contact.force, abs=1e-7)  # of 1 N
    _, free, far = touching_loop("obstacle=[{kind='halfspace', normal=[0, 1], offset=-3}]", **law)
    assert (free.q_s == far.q_s).all()
    assert (free.inputs == far.inputs).all()
    assert not far.contact.touching.any()


@pytest.mark.ranks(2)
def test_at_rest_feedback_balances_the_obstacle() -> None:
    """The static problem of hand, tissue and floor, K z = N'x, u + N_s'x = 0, N z + N_s q = -0.95 below the body."""
    found, _, run = touching_loop("control.Q=100", FLOOR[1], dt=0.2, steps=1000, comm=MPI.COMM_SELF)
    assert run.contact.touching[-1, 0] == 5  # all of the lower edge
    system, gain, target = found.problem.system, found.gain, found.target
    bottom = 2 * np.flatnonzero(system.layout.nodes[:, 1] < 1e-12) + 1
    n, k = len(gain.K_z), len(bottom)
    K = to_scipy(system.K_ee).toarray()
    N = np.zeros((k, n))
    N[np.arange(k), bottom] = 1.0
    N_s = np.tile([0.0, 1.0], (k, 1))
    A = np.block([[np.zeros((n, 2)), K, -N.T], [gain.K_s[:, :2], gain.K_z.T, N_s.T], [N_s, N, np.zeros((k, k))]])
    right = np.concatenate([np.zeros(n), gain.K_s[:, :2] @ target.state.q_s - target.u, np.full(k, -0.95)])
    q, _, x = np.split(np.linalg.solve(A, right), [2, 2 + n])
    assert (x > 0).all()
    assert run.q_s[-1] == pytest.approx(q, abs=1e-6)  # what is left of the move
    assert run.contact.force_end[0] == pytest.approx([0.0, x.sum()], rel=1e-3, abs=1e-5)


def test_a_loop_without_obstacles_cannot_meet_them() -> None:
    found = sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    loop = sg.ClosedLoop(found.problem, 0.1)
    with pytest.raises(ControlError, match="make it with ClosedLoop"):
        loop.run(found.gain, found.target, 2, options=LoopOptions(touching=True))
    loop.destroy()


OTHERS = [
    (["tissue.cells=[2, 6]", *FLOOR], "give the model of the same mesh and hand"),
    (["tissue.cells=[2, 4]"], "has effects.obstacles = false"),
]


@pytest.mark.parametrize(("overrides", "words"), OTHERS)
def test_a_scene_that_does_not_fit_the_loop_is_refused(overrides: list[str], words: str) -> None:
    found = sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    loop = sg.ClosedLoop(found.problem, 0.1, scene=sg.build("paper_lqr", overrides))
    with pytest.raises(ControlError, match=words):
        loop.run(found.gain, found.target, 2, options=LoopOptions(touching=True))
    loop.destroy()


@pytest.mark.serial
def test_rounds_that_do_not_end_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.lqr.loop.touching.MOST", 1)
    with pytest.raises(SolverError, match="feedback and the forces of obstacles do not agree after 1 rounds"):
        touching_loop()
