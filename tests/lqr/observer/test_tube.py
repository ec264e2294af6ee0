"""Feedback around a plan: the plan from its own nominal state, the full plant near to it, and the next plan."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained.plan import make_plan
from softgrasp.lqr.constrained.separation import gaps as apart
from softgrasp.lqr.constrained.tissue import modal_tissue
from softgrasp.lqr.design.constrained import PlannedControl, plan_control
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.observer import ObservedControl, observe
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.observer.tube import node_rows, run_tube
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.replan import Outcome

OBSERVER = (
    "control.observer={markers=[[0,0],[1,0],[0,1],[1,1]],disturbance={hand=2e-4,load=5e-4,box=[[0,0],[1,0]]},delay=1}"
)


@cache
def planned(*overrides: str) -> tuple[PlannedControl, ObservedControl, np.ndarray]:
    model = build(load_scene("paper_obstacle", ["tissue.cells=[4,8]", OBSERVER, *overrides]))
    made, watch = design(model), Stopwatch(model.system.layout.comm)
    observed = observe(made, watch)
    found = plan_control(made, watch, observed=observed)
    return found, observed, node_rows(modal_tissue(made.problem, found.surface), 2)


def robot(found: PlannedControl) -> Controller:
    assert found.online is not None, found.reason
    return found.online.controller


def gaps(found: PlannedControl, moved: np.ndarray) -> np.ndarray:
    task = found.plan.task
    return np.array([apart(shape, task.places + moved) for shape in task.shapes])


def test_without_noise_the_tube_follows_the_plan() -> None:
    found, observed, rows = planned()
    assert found.plan.certified
    ticks = 40_000  # 40 s: beyond the horizon of 32 intervals
    still = replace(observed.ticks, W=0 * observed.ticks.W)
    run = run_tube(robot(found), still, rows, ticks, 125, seed=None, again=False)
    steps = len(found.plan.inputs)
    # at the instants of the plan the body is where the reduced plant has it, but for what that leaves out
    body = found.plan.body()[:, :-1].reshape(-1, *found.plan.task.places.shape)
    off = run.moved[: 8 * steps] + found.plan.task.places - body
    assert np.abs(off).max() < found.plan.task.error.max()
    assert gaps(found, run.moved).min() >= 0
    assert np.abs(run.moved[-1]).max() < 0.01  # it is nearly there
    assert np.abs(np.diff(run.inputs[8 * steps - 1 :: 8], axis=0)).max() < 0.01  # the tail goes on without a jump


def test_noise_keeps_within_the_deviations_of_the_plan() -> None:
    found, observed, rows = planned()
    sd = np.sqrt(np.einsum("jdd->jd", found.online.covariance))
    assert found.plan.task.noise.max() == pytest.approx(3 * sd.max(), rel=1e-12)
    ticks, own = 32_000, robot(found)
    noisy = run_tube(own, observed.ticks, rows, ticks, 125, again=False).moved
    still = replace(observed.ticks, W=0 * observed.ticks.W)
    calm = run_tube(own, still, rows, ticks, 125, seed=None, again=False).moved
    share = (noisy - calm).std(axis=0) / sd
    # 32 s are half a time constant of the slowest mode; the rest forgets in a second
    assert 0.3 < np.median(share) < 1.3


def test_new_plans_from_the_estimate_keep_every_gap_under_noise() -> None:
    found = planned()[0]
    assert found.online.gaps.min() >= 0
    outcomes = [entry.outcome for entry in found.online.log]
    assert outcomes.count(Outcome.NEW) > 0.8 * len(outcomes)
    assert Outcome.SOFT not in outcomes  # noise does not leave the tube


def test_every_later_nominal_state_has_a_plan_that_costs_no_more() -> None:
    found = planned()[0]
    plan = found.plan
    horizon, task = plan.horizon, plan.task
    x, u = horizon.state(task.start, plan.c), horizon.input(task.start, plan.c)
    P, cost = horizon.plant.P, plan.cost
    for k in (0, 4, 5):  # the disc is passed in interval 5
        start = x[k, -1]
        later = make_plan(horizon.plant, replace(task, start=start), horizon.steps)
        shifted = float(start @ P @ start + plan.c[2 * (k + 1) :] @ plan.c[2 * (k + 1) :])  # goes on, then the gain
        assert later.certified
        assert later.cost <= shifted * (1 + 1e-3)  # rounds stop at 2e-4 of the cost of obstacles
        assert shifted < cost
    assert len(u) == horizon.steps


def test_an_interval_must_hold_whole_ticks() -> None:
    assert "grid = 1 s must be a multiple of the tick of 0.3 s" in planned("control.loop.rate=3.3333333333")[0].reason
    with pytest.raises(ControlError, match="leave nothing of"):
        planned("control.constraints.noise=1e5")


@pytest.mark.slow
def test_tube_keeps_every_gap_for_1e5_ticks_of_bounded_noise() -> None:
    found, observed, rows = planned("control.constraints.noise=4.0")
    for again in (False, True):
        run = run_tube(robot(found), observed.ticks, rows, 100_000, 5, seed=1, again=again)
        assert gaps(found, run.moved).min() >= 0
        limits = found.plan.task.limits.force
        assert np.abs(run.inputs).max() <= 8 >= limits.max()
        assert Outcome.SOFT not in [entry.outcome for entry in run.log]
