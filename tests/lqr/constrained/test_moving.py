"""Plans past obstacles on a known path, and in space, judged on the full plant."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.obstacles.obstacle import Spline, Uniform
from softgrasp.fem.obstacles.shapes import Ball
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained.horizon import held_cost
from softgrasp.lqr.constrained.plan import MOST_WAYS, _ways
from softgrasp.lqr.constrained.task import after_paths, at_target, path_turns
from softgrasp.lqr.design.constrained import PlannedControl, plan_control
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.replan import Outcome

pytestmark = pytest.mark.serial  # the plan is made on one rank; tests of plans past what rests run on ranks
CROSSING = "obstacle=[{kind='disc', center=[3.4, 4.2], radius=0.7, path={velocity=[0.0, -0.5]}}]"
SMALL = ("tissue.cells=[2,4]", "control.loop.rate=100", "control.constraints.N=14", "control.constraints.parts=4")


@cache
def planned(scene: str, *overrides: str, online: bool = False) -> PlannedControl:
    model = build(load_scene(scene, list(overrides)), comm=MPI.COMM_SELF)
    return plan_control(design(model), Stopwatch(MPI.COMM_SELF), online=online)


def least_distance(body: np.ndarray, centers: np.ndarray) -> float:
    """Least distance of the nodes from a point that moves."""
    return float(np.linalg.norm(body - centers[:, None], axis=2).min())


def test_a_disc_that_crosses_the_way_is_passed_where_it_is_then() -> None:
    found = planned("paper_obstacle", *SMALL, CROSSING, online=True)
    run = found.runs.planned
    centers = np.array([3.4, 4.2]) + run.times[:, None] * [0.0, -0.5]
    assert found.plan.certified
    assert run.least[0] >= 0
    # the nodes are no nearer than the hull, and a node is near to where it touches: sides of 0.5 m, a disc of 0.7 m
    assert run.least[0] - 1e-12 <= least_distance(run.body, centers) - 0.7 < run.least[0] + 0.05
    assert found.runs.free.least[0] < -0.3  # the optimal feedback meets it on its way
    assert found.online is not None, found.reason
    assert found.online.gaps.min() >= 0
    assert all(entry.outcome is not Outcome.SOFT for entry in found.online.log)


def test_path_of_a_table_is_kept_until_it_ends(tmp_path: Path) -> None:
    table = tmp_path / "path.csv"
    table.write_text("t,x,y\n0,0,0\n3,0,-1.2\n6,0,-0.4\n9,0,-3.0\n")
    found = planned("paper_obstacle", *SMALL, CROSSING.replace("velocity=[0.0, -0.5]", f"csv='{table}'"))
    plan, run = found.plan, found.runs.planned
    assert plan.certified
    spline = scipy.interpolate.CubicSpline([0, 3, 6, 9], [[0, 0], [0, -1.2], [0, -0.4], [0, -3.0]], bc_type="clamped")
    centers = np.array([3.4, 4.2]) + spline(np.minimum(run.times, 9.0))
    assert run.least[0] >= 0
    assert least_distance(run.body, centers) >= 0.7 + run.least[0] - 1e-12  # rounding


def test_acceleration_of_a_path_is_bounded() -> None:
    times, rng = np.array([0.0, 0.3, 1.0, 1.1, 2.0]), np.random.default_rng(0)
    path = Spline(scipy.interpolate.CubicSpline(times, rng.standard_normal((5, 3)), bc_type="clamped"))
    for begin, end in ((0.0, 0.2), (0.25, 1.05), (0.5, 2.5), (2.1, 3.0)):
        inside = np.linspace(begin, end, 400)
        fastest = np.abs([path(t, 2) for t in inside]).max(axis=0)
        bound = path.fastest_turn(begin, end)
        assert (fastest <= bound * (1 + 1e-12)).all()  # rounding
        if end < 2:
            assert np.allclose(fastest, bound, rtol=0.1)  # linear between the times: the samples nearly meet the ends
    assert np.array_equal(path(5.0), path(2.0))
    assert not path(5.0, 1).any()
    moving = Uniform(np.array([1.0, 0.0, 2.0]))
    assert np.array_equal(moving(0.5), [0.5, 0.0, 1.0])
    assert np.array_equal(moving(0.5, 1), [1.0, 0.0, 2.0])
    assert not moving.fastest_turn(0.0, 1.0).any()
    assert not moving(0.5, 2).any()


def test_an_obstacle_that_keeps_coming_is_refused() -> None:
    with pytest.raises(ControlError, match="obstacle disc1 moves towards the body at the target until the end"):
        planned("paper_obstacle", *SMALL, CROSSING.replace("[0.0, -0.5]", "[0.01, 0.0]"))


def test_an_obstacle_that_passes_through_the_target_has_to_leave_room_there() -> None:
    plan = planned("paper_obstacle", *SMALL, CROSSING, online=True).plan
    plant, low, high = plan.horizon.plant, plan.task.places.min(axis=0), plan.task.places.max(axis=0)
    ball = Ball(np.array([low[0] / 2 + high[0] / 2, high[1] + 20.0]), 0.5)
    task = replace(plan.task, shapes=(ball,), names=("ball",), paths=(Uniform(np.array([0.0, -0.5])),))
    gone = (20.0 + 2.0 + 0.5) / 0.5  # its top is below the body, of height 2 m, from then on [s]
    steps = after_paths(plant, task, 1, 400)
    assert gone < steps * plant.grid < gone + 2 * plant.grid  # clearance and margin are less than an interval's way
    assert at_target(task, steps * plant.grid)[0][1].min() > 0
    soon = int(gone / plant.grid)  # it leaves, and is still in the body
    with pytest.raises(ControlError, match="at the target the gap to obstacle ball"):
        at_target(task, after_paths(plant, task, 1, soon) * plant.grid)


def test_a_path_that_has_ended_needs_no_margin() -> None:
    horizon = planned("paper_obstacle", *SMALL, CROSSING, online=True).plan.horizon
    end = 2 * horizon.plant.grid
    spline = scipy.interpolate.CubicSpline([0.0, end], [[0.0, 0.0], [0.0, -3.0]], bc_type="clamped")
    task = replace(planned("paper_obstacle", *SMALL, CROSSING, online=True).plan.task, paths=(Spline(spline),))
    turns = path_turns(horizon, task, 0, np.tile([0.0, 1.0], (4, 1)))
    assert turns[:2].max() == pytest.approx(6 * 3.0 / end**2)  # of s = 3 t^2 - 2 t^3
    assert not turns[2:].any()


@pytest.mark.parametrize(("d", "count"), [(2, 4), (2, 40), (3, 2), (3, 30)])
def test_every_obstacle_is_passed_on_every_side_where_not_all_ways_are_tried(d: int, count: int) -> None:
    ways = _ways(d, count)
    assert len(set(ways)) == MOST_WAYS
    for sides in zip(*ways, strict=True):
        assert set(sides) == set((1, -1, 2, -2)[: 2 * (d - 1)])


def test_few_obstacles_are_passed_in_all_ways() -> None:
    assert _ways(3, 0) == [()]
    assert set(_ways(2, 3)) == set(product((1, -1), repeat=3))
    assert set(_ways(3, 1)) == {(1,), (-1,), (2,), (-2,)}


SPACE = ("tissue.cells=[2,2,2]", "control.constraints.parts=2", "control.loop.rate=1000")


def test_a_body_in_space_goes_over_a_box_and_past_a_ball_that_moves() -> None:
    found = planned("reach_over_3d", *SPACE, online=True)
    plan, run = found.plan, found.runs.planned
    assert plan.certified
    assert 0 < found.runs.reduction_error <= np.linalg.norm(plan.task.error, axis=1).max()
    assert (run.least >= 0).all()
    assert found.online is not None
    assert (found.online.gaps >= 0).all()  # also where the hand holds nodes, which see no mode
    assert found.runs.free.least[0] < -0.02  # the optimal feedback goes through the box
    centers = np.array([0.17, 0.1, 0.2]) + run.times[:, None] * [0.0, 0.0, -0.2]
    assert least_distance(run.body, centers) >= 0.03 + run.least[1] - 1e-12  # rounding
    x, y, z = np.moveaxis(run.body, 2, 0)
    over = (x > 0.14) & (x < 0.2) & (y < 0.2)
    assert over.any()
    assert z[over].min() >= 0.03 + run.least[0] - 1e-12  # no node is lower than the gap above the box
    assert [sides for sides, _, _ in plan.tried] == [(1,), (-1,), (2,), (-2,)]


def test_cost_of_a_held_input_is_an_integral_of_a_stiff_plant() -> None:
    A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.4, 0.0], [0.0, 0.0, -2e4]])  # e^{3e4} overflows
    B, W, s = np.array([[0.0], [1.0], [1e3]]), np.diag([1.0, 0.5, 2.0, 0.3]), 1.5
    full = np.array([0.3, -0.2, 1.0, 0.7])
    rest = np.linalg.solve(A, -B[:, 0] * full[3])

    def integrand(t: float) -> float:
        slow = rest[:2] + scipy.linalg.expm(A[:2, :2] * t) @ (full[:2] - rest[:2])
        now = np.array([*slow, rest[2] + np.exp(A[2, 2] * t) * (full[2] - rest[2]), full[3]])
        return float(now @ W @ now)

    parts = [0.0, 1e-4, 1e-3, 0.1, 0.8, s]
    exact = sum(scipy.integrate.quad(integrand, a, b, epsabs=1e-13)[0] for a, b in pairwise(parts))
    assert full @ held_cost(A, B, W, s) @ full == pytest.approx(exact, rel=1e-9)  # tolerance of the quadrature
