"""Plans made again online: the rows left out against all of them; what is taken, kept and given up."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained import online
from softgrasp.lqr.constrained.horizon import Horizon
from softgrasp.lqr.constrained.online import Ticks, make_program
from softgrasp.lqr.constrained.plan import Plan
from softgrasp.lqr.constrained.separation import gaps, separate
from softgrasp.lqr.constrained.thin import Order, Thinned
from softgrasp.lqr.design.constrained import PlannedControl, plan_control
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.program import HARD, Program
from softgrasp.lqr.program.replan import Outcome, Replanner

pytestmark = pytest.mark.serial
NOISE = 1e-3  # of a start near the way: of the hand [m, m/s], of swings of the tissue [m/s]


@cache
def planned(*overrides: str) -> PlannedControl:
    changes = ["tissue.cells=[4,8]", "control.loop.rate=100", *overrides]
    model = build(load_scene("paper_obstacle", changes), comm=MPI.COMM_SELF)
    return plan_control(design(model), Stopwatch(MPI.COMM_SELF))


def robot(found: PlannedControl) -> Controller:
    assert found.online is not None, found.reason
    return found.online.controller


def program(found: PlannedControl) -> Program:
    own = robot(found).planner
    assert own is not None
    return own


def every_row(order: Order, v: np.ndarray, seen: np.ndarray, *rest: np.ndarray) -> Thinned:
    """No row stands for another."""
    some = np.arange(v.shape[1])
    return Thinned(some, np.ones(v.shape, dtype=bool), np.zeros(v.shape), np.zeros((*v.shape, seen.shape[1])))


def dense(found: PlannedControl) -> Program:
    """The same with all rows."""
    own, run = program(found), robot(found)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("BOX", "STILL", "FASTER"):
            patch.setattr(online, name, 1e6)
        patch.setattr(online, "thinned", every_row)
        return make_program(found.plan, own.T, run.x_bar, Ticks(own.A, own.B, own.f), run.period)


def states(own: Program, intervals: int, rng: np.random.Generator) -> list[tuple[int, np.ndarray]]:
    """States near the way of the first plan, and beyond its horizon."""
    result = []
    for j in rng.integers(0, own.H + 8, intervals).tolist():
        x = own.way[j].copy() if j < own.H else np.zeros(len(own.F))
        swing = own.swing_x[0, :, 0, 4:]  # omega eta of every mode, at the beginning of an interval
        pace = np.abs(swing[:, : len(swing)]).max(axis=1)
        x[:4] += NOISE * rng.standard_normal(4)
        x[4:] += NOISE * rng.standard_normal(len(x) - 4) / np.concatenate([pace, np.ones(len(pace))])
        result.append((j, x))
    return result


def kept(plan: Plan, x: np.ndarray, c: np.ndarray) -> float:
    """Least gap of the whole body of the reduced plant over four horizons under c, less the margin of the plan [m]."""
    horizon, task = Horizon(plan.horizon.plant, 4 * plan.horizon.steps), plan.task
    longer = np.concatenate([c.ravel(), np.zeros(3 * c.size)])
    body = task.places + np.einsum("jdn,kin->kijd", horizon.plant.Y, horizon.state(x, longer))
    every = body.reshape(-1, *task.places.shape)
    least = [gaps(shape, every).min() for shape in task.shapes]
    return float(min(least)) - task.clearance


def test_rows_that_are_left_out_are_never_broken() -> None:
    found = planned()
    own, every = program(found), dense(found)
    assert own.count(0) < every.count(0) / 16
    kind = np.repeat(np.arange(every.H + 1), np.diff(every.first))
    first = np.vstack([every.way_c, np.zeros((1, every.n_s))])[kind]
    gap = (every.a * every.way[kind]).sum(axis=1) + (every.coefficients[:, -2:] * first).sum(axis=1) + every.exact
    narrow = replace(every, free=every.free - np.where(every.obstacle == HARD, 0.0, online.GIVEN * gap))
    taken, rng = 0, np.random.default_rng(0)
    for j, x in states(own, 30, rng):
        try:
            c, _, _ = own.solve(j, x)
        except ControlError:
            with pytest.raises(ControlError):  # fewer rows hold whatever all rows hold
                every.solve(j, x)
            continue
        all_rows = every.solve(j, x)[0]
        if own.judge(j, x, c):
            continue
        taken += 1
        G, h, _, _ = every.system(j, x)
        assert (G @ c.ravel() - h).max() < 1e-12  # rounding of rows of size one
        # as cheap as with all rows, or with all of them nearer by what a row may keep for others
        least, most = (float((e**2).sum()) for e in (all_rows, narrow.solve(j, x)[0]))
        assert least * (1 - 1e-9) <= (c**2).sum() <= most * (1 + 1e-9)  # by other steps
        assert not every.judge(j, x, c)
        assert kept(found.plan, x, c) >= 0
    assert taken >= 20


def test_a_plan_out_of_the_box_is_not_taken() -> None:
    own = program(planned())
    x = own.way[10].copy()
    x[0] -= 0.5  # of a body of two metres
    c, _, _ = own.solve(10, x)
    assert "leaves the box" in own.judge(10, x, c)
    x = own.way[10].copy()
    x[-1] += 0.05
    assert "swings more" in own.judge(10, x, own.solve(10, x)[0])


def test_judgement_finds_each_defect() -> None:
    own = program(planned())
    c = own.c
    assert not own.judge(0, own.start, c)
    faster = c.copy()
    faster[0] *= 3
    assert own.judge(0, own.start, faster)
    assert "behind the horizon" in replace(own, tail_real=1e6 * own.tail_real).judge(0, own.start, c)
    narrow = replace(own, exact=np.where(own.obstacle == HARD, own.exact, own.exact - 1.0))
    assert "nearer than the clearance" in narrow.judge(0, own.start, c)
    weak = replace(own, exact=np.where(own.obstacle == HARD, own.exact - 8.0, own.exact))
    assert "limit of the hand" in weak.judge(0, own.start, c)


def test_the_last_plan_shifted_is_safe_again_and_again() -> None:
    """Recursive feasibility: without any new plan the old one passes the judgement of every later interval."""
    found = planned()
    own, run = program(found), robot(found)
    follower = Replanner(own, run.K, run.x_bar, run.u_bar, again=False)
    for interval in range(own.H + 5):
        assert not own.judge(interval, follower.x, follower.c)
        for _ in range(own.every):
            follower.command(follower.nominal)


def test_without_disturbances_new_plans_are_the_old_one() -> None:
    found = planned()
    log = found.online.log if found.online else ()
    assert [entry.outcome for entry in log] == [Outcome.NEW] * found.plan.horizon.steps
    assert sum(entry.steps for entry in log[1:]) <= 3  # the shifted active set is the answer
    assert (found.online.gaps >= 0).all() if found.online else False


def pushed(found: PlannedControl, impulse: np.ndarray, at: int, again: bool) -> tuple[float, list[Outcome], float]:
    """Least gap, outcomes and largest load where the hand is pushed in the last three ticks before an interval [N s].

    On the plan's own plant; the robot does not know of the push.
    """
    run, own = robot(found), program(found)
    run.reset()
    run.replanner.again = again
    x, task, least, most = own.rest.copy(), found.plan.task, np.inf, 0.0
    for tick in range((own.H + 10) * own.every):
        u = run.step(x[:2], x[2:4])
        most = max(most, float(np.abs(u).max()))
        push = impulse / (3 * run.period) if 0 < at * own.every - tick <= 3 else 0.0
        x = own.A @ x + own.B @ (u + push) + own.f
        if tick % 12 == 0:
            body = task.places + (found.plan.horizon.plant.Y @ (own.T @ (x - run.x_bar)))
            least = min(least, *(separate(shape, body)[1] for shape in task.shapes))
    return least, [entry.outcome for entry in run.replanner.log], most


def test_pushes_are_answered_by_new_plans() -> None:
    """Before the disc and towards the wall: K alone comes back slowly and goes 9 mm and 56 mm inside."""
    found = planned()
    for impulse, at, depth in (([0.0, -0.2], 4, 5e-3), ([0.6, 0.0], 12, 3e-2)):
        following, _, _ = pushed(found, np.array(impulse), at, again=False)
        least, outcomes, most = pushed(found, np.array(impulse), at, again=True)
        assert following < -depth
        assert least >= 0
        assert outcomes[-1] is Outcome.NEW
        assert most <= 8 * (1 + 1e-12)


def test_a_push_that_leaves_no_gap_gives_it_up() -> None:
    """A hand of 20 kg that gets 5 cm/s at 5 cm from the wall, for half an interval: part of the way is lost."""
    found = planned()
    following, _, _ = pushed(found, np.array([1.0, 0.0]), 24, again=False)
    least, outcomes, most = pushed(found, np.array([1.0, 0.0]), 24, again=True)
    assert following < 3 * least < 0  # 87 mm and 12 mm
    assert outcomes.count(Outcome.SOFT) >= 1
    assert most <= 8 * (1 + 1e-12)


@pytest.mark.slow
def test_jumps_of_all_plans_keep_their_limit() -> None:
    found = planned("control.constraints.jump=1.0", "control.constraints.parts=4", "obstacle=[{kind='halfspace', "
                    "normal=[-1, 0], offset=-6.05}]")  # fmt: skip
    run, own = robot(found), program(found)
    assert len(own.F) == found.plan.horizon.plant.N + 2
    run.reset()
    x, loads, rng = own.rest.copy(), [np.zeros(2)], np.random.default_rng(1)
    for tick in range(20 * own.every):
        u = run.step(x[:2], x[2:4])
        if tick % own.every == 0:
            loads.append(run.replanner.planned - run.u_bar)
            x[2:4] += 1e-3 * rng.standard_normal(2)
        x = own.A @ x + own.B @ u + own.f
    assert sum(entry.outcome is Outcome.NEW for entry in run.replanner.log) > 5
    assert np.abs(np.diff(loads, axis=0)).max() <= 1 + 1e-9


def test_file_holds_the_plan(tmp_path: Path) -> None:
    own = robot(planned())
    again = Controller.load(own.save(tmp_path / "plan.npz"))
    own.reset()
    q, v = program(planned()).rest[:2], np.zeros(2)
    for _ in range(3):
        assert np.array_equal(own.step(q, v), again.step(q, v))
    with pytest.raises(ControlError, match="this controller follows a plan to its own target"):
        again.towards(np.zeros(2))
    with pytest.raises(ControlError, match="the plan has 5 states"):
        replace(own, planner=replace(own.planner, T=own.planner.T[:, :5]) if own.planner else None)


def test_plans_that_keep_nothing_are_not_made_again() -> None:
    found = planned()
    own = program(found)
    unsafe = replace(found.plan, unsafe=3)
    with pytest.raises(
        ControlError, match="only a plan that keeps everything is made again online; behind the horizon"
    ):
        make_program(unsafe, own.T, robot(found).x_bar, Ticks(own.A, own.B, own.f), 1e-2)
    with pytest.raises(ControlError, match=r"grid = 1 s must be a multiple of the tick of 0.3 s"):
        make_program(found.plan, own.T, robot(found).x_bar, Ticks(own.A, own.B, own.f), 0.3)


def test_a_plan_goes_on_without_a_hand_and_its_file_has_a_format_of_its_own(tmp_path: Path) -> None:
    own = robot(planned())
    path = own.save(tmp_path / "plan.npz")
    with np.load(path) as file:
        assert json.loads(str(file["meta"]))["format"] == 2  # a reader without plans refuses it
    run = Controller.load(path)
    run.reset()
    q, v = run.planner.rest[:2], np.zeros(2)
    last = run.step(q, v)
    for _ in range(run.planner.every):
        assert np.array_equal(run.step(np.full(2, np.nan), v), last)
    assert [entry.outcome for entry in run.replanner.log] == [Outcome.NEW, Outcome.KEPT]
    assert "not finite" in run.replanner.log[1].reason
    plain = replace(own, planner=None).save(tmp_path / "plain.npz")
    with np.load(plain) as file:
        assert json.loads(str(file["meta"]))["format"] == 1
    assert Controller.load(plain).planner is None
