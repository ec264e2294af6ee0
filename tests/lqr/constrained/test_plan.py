"""Plans past the paper's wall and disc, judged on the full plant; what is infeasible, refused, or certified."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Shape
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained import plan as planning
from softgrasp.lqr.constrained.horizon import HeldPlant, held_plant
from softgrasp.lqr.constrained.plan import Plan, make_plan, quadratic_program
from softgrasp.lqr.constrained.pulse import PulseError
from softgrasp.lqr.constrained.rows import Limits, follow
from softgrasp.lqr.constrained.run import PlanRuns, run_plan
from softgrasp.lqr.constrained.task import Task
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface, make_surface, modal_tissue
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.target import hand_target, rest
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.lqr.riccati import solve
from tests.helpers.least_distance import least_squares

WALL = HalfSpace(np.array([-1.0, 0.0]), -6.05)  # 5 cm behind the target of the right edge
DISC = Ball(np.array([3.4, 1.2]), 0.7)  # on the way
TARGET, FORCE, SPEED = np.array([5.0, 3.0]), 8.0, 2.0


@cache
def paper(cells: str = "[10, 20]") -> tuple[RiccatiProblem, RiccatiSolution, Surface, ModalTissue]:
    model = build(load_scene("paper_lqr", [f"tissue.cells={cells}"]), comm=MPI.COMM_WORLD)
    problem = make_problem(model)
    surface = make_surface(problem.layout, *model.space.surface())
    return problem, solve(problem), surface, modal_tissue(problem, surface)


def task(N: int, *shapes: Shape, cells: str = "[10, 20]") -> tuple[HeldPlant, Task]:
    problem, _, surface, full = paper(cells)
    reduced = full.reduced((N - 4) // 2, 1.0)
    plant = held_plant(problem, reduced, 1.0, 8)
    error = PulseError(full, reduced, 1.0).bound(np.full(2, FORCE / 20))
    start = np.zeros(N)
    start[:2] = -TARGET
    names = tuple(f"{i}" for i in range(len(shapes)))
    limits = Limits(np.full(2, FORCE), SPEED)
    return plant, Task(start, surface.nodes + TARGET, np.zeros(2), shapes, names, error, limits=limits)


def run(plan: Plan, cells: str = "[10, 20]") -> PlanRuns:
    problem, solution, surface, full = paper(cells)
    return run_plan(problem, solution, plan, surface, full, rest(problem.system), hand_target(problem, TARGET))


def inputs_until(plan: Plan, intervals: int) -> np.ndarray:
    """Inputs of the plan, behind its horizon those of the gain K, (intervals, n_s)."""
    horizon = plan.horizon
    end = horizon.state(plan.task.start, plan.c)[-1, -1]
    _, tail = follow(horizon.plant, end, -1.0, intervals - horizon.steps)
    return np.concatenate([plan.inputs, tail + plan.task.u_bar])


@pytest.mark.parametrize(("N", "margin"), [(14, 1.5e-3), (22, 2.1e-4), (30, 1.1e-4)])
def test_wall_is_kept_on_the_full_plant(N: int, margin: float) -> None:
    plant, given = task(N, WALL)
    plan = make_plan(plant, given, 30)
    runs = run(plan)
    optimal = runs.free.cost
    assert plan.certified
    assert given.error.max() < margin  # at every time, 1.33e-3, 1.97e-4 and 1.184e-4; N = 30 at the rows alone 9.9e-5
    assert runs.planned.least[0] >= 0
    assert runs.free.least[0] < -0.17  # LQR goes through the wall
    assert np.abs(runs.planned.inputs).max() <= FORCE * (1 + 1e-9)
    assert np.abs(runs.planned.v_s).max() <= SPEED * (1 + 1e-9)
    assert plan.cost / optimal - 1 < 5.2e-3
    # the reduced plant predicts the cost of the full one: step error of the run and tissue that it leaves out
    assert abs(runs.planned.cost / plan.cost - 1) < 1e-5
    assert runs.reduction_error <= np.linalg.norm(given.error, axis=1).max()
    assert runs.step_error < 1e-4  # phase of the midpoint steps of 5 ms


@pytest.mark.serial  # on ranks the plan of a small plant, below
def test_without_margin_the_full_plant_hits_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "ROOM", 0.0)
    plant, given = task(30, WALL)
    plan = make_plan(plant, replace(given, error=np.zeros_like(given.error)), 30)
    assert not plan.certified
    assert "between two instants" in plan.reason
    assert run(plan).planned.least[0] < -2e-5


@pytest.mark.serial  # on ranks the plan of a small plant, below
def test_disc_is_passed_on_the_cheaper_side() -> None:
    plant, given = task(14, DISC)
    plan = make_plan(plant, given, 30)
    runs = run(plan)
    assert plan.certified
    assert plan.sides == (1,)
    assert {sides: cost for sides, cost, _ in plan.tried}[(-1,)] > 20 * plan.c @ plan.c
    assert runs.planned.least[0] >= 0
    assert runs.free.least[0] < -0.45
    assert runs.planned.cost / runs.free.cost - 1 < 3.2e-2
    assert all(b < a for a, b in zip(plan.costs, plan.costs[1:], strict=False))  # every round is safe for the next


@pytest.mark.ranks(2)
def test_plan_of_a_small_plant_is_the_same_on_all_ranks() -> None:
    plant, given = task(14, WALL, DISC, cells="[4, 8]")
    plan = make_plan(plant, given, 30)
    runs = run(plan, cells="[4, 8]")
    assert plan.certified
    assert (runs.planned.least >= 0).all()
    # the value of one rank: another order of the nodes moves it by rounding, and the rounds end at 2e-4 of it
    assert abs(plan.c @ plan.c - 6.563045) < 1e-4
    for value in (plan.cost, *runs.planned.least):
        assert MPI.COMM_WORLD.allreduce(value, MPI.MAX) == value


def test_program_of_a_plan_is_solved_as_by_least_squares() -> None:
    plant, given = task(14, WALL, DISC, cells="[4, 8]")
    plan = make_plan(plant, given, 30)
    G, h = quadratic_program(plan)
    found = nearest(G, h, plan.active)
    near = np.argsort(h - G @ found.x)[:985]  # the oracle is slow for all 13 000 rows; the others are kept
    assert (G @ found.x - h).max() < 1e-12  # rounding of rows of size one
    assert np.abs(found.x - least_squares(G[near], h[near])).max() < 1e-11  # the oracle divides by its residual


def test_multiplier_is_what_a_metre_of_a_gap_costs() -> None:
    plant, given = task(14, WALL, cells="[4, 8]")
    plan = make_plan(plant, given, 30)
    G, h = quadratic_program(plan)
    found = nearest(G, h, plan.active)
    nearer = h.copy()
    nearer[np.argmax(found.multipliers)] -= 1e-6  # a micrometre less room
    more = nearest(G, nearer, plan.active).x
    # one more round of half-planes and bends moves it by SETTLED or so, the quotient by 1e-6 times its slope
    assert abs(plan.multiplier / ((more @ more - found.x @ found.x) / 1e-6) - 1) < 1e-2
    pressed = make_plan(plant, replace(given, shapes=(), names=(), limits=Limits(np.full(2, 1.0))), 30)
    assert pressed.active
    assert pressed.multiplier == 0  # newtons of a limit are no metres of a gap


def test_programs_beyond_the_memory_are_refused_before_they_are_built() -> None:
    plant, given = task(14, WALL, cells="[4, 8]")
    with pytest.raises(
        ResourceError, match=r"a plan of 1e\+06 intervals would need about .* control.constraints.horizon"
    ):
        make_plan(plant, given, 1_000_000, 1_000_000)


def test_start_inside_an_obstacle_is_a_result() -> None:
    plant, given = task(14, HalfSpace(np.array([1.0, 0.0]), 0.1), cells="[4, 8]")  # 0.1 m over the left edge
    plan = make_plan(plant, given, 30)
    assert not plan.certified
    assert abs(plan.depth - 0.1 - given.error[:, 0].max()) < 5e-3  # depth, margin and bend
    assert 0 < plan.outside < 10
    assert f"{plan.outside:.4g} s" in plan.reason
    body = plan.body()[round(plan.outside) + 1 :]
    assert body[..., 0].min() > 0.1  # outside for good


def test_tail_lengthens_a_horizon_that_ends_before_the_overshoot() -> None:
    plant, given = task(14, WALL, cells="[4, 8]")
    plan = make_plan(plant, given, 8)
    assert plan.certified
    assert plan.horizon.steps > 8


def test_jumps_keep_their_limit() -> None:
    plant, given = task(14, WALL, cells="[4, 8]")
    free = make_plan(plant, given, 30)
    plan = make_plan(plant, replace(given, limits=Limits(jump=1.0)), 30)
    jumps = np.abs(np.diff(inputs_until(plan, 60), axis=0, prepend=0.0)).max()
    assert np.abs(np.diff(free.inputs, axis=0, prepend=0.0)).max() > 2
    assert jumps <= 1 + 1e-9
    assert plan.certified


def test_limits_that_are_too_slow_are_refused_before_a_plan() -> None:
    plant, given = task(14, WALL, cells="[4, 8]")
    for limits, least in ((Limits(speed=1e-3), "5000"), (Limits(np.full(2, 1e-3)), "632.5")):  # 5 / v, 2 sqrt(5 M / F)
        with pytest.raises(ControlError, match=rf"at least {least} s to the target, and a plan lasts 120 s"):
            make_plan(plant, replace(given, limits=limits), 30)


def test_targets_without_a_gap_are_refused() -> None:
    plant, given = task(14, HalfSpace(np.array([-1.0, 0.0]), -6.0001), cells="[4, 8]")
    with pytest.raises(ControlError, match=r"at the target the gap to obstacle 0 is 0\.0001 m and a plan needs"):
        make_plan(plant, given, 30)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [("tissue.order=2", "elements of order 1"),
     ("effects.finite_strain={}", "effects.finite_strain"),
     ('effects.damping={kind="rayleigh", beta=0.002, alpha=0.1, drag="space"}', "acts against the hand"),
     ('effects={reaction=true, damping={kind="rayleigh", beta=0.002, alpha=0.1}}', "only with Kelvin-Voigt damping")],
)  # fmt: skip
def test_plants_without_a_plan_are_refused(override: str, sentence: str) -> None:
    model = build(load_scene("paper_lqr", ["tissue.cells=[4, 8]", override]))
    problem = make_problem(model)
    with pytest.raises(ControlError, match=sentence):
        modal_tissue(problem, make_surface(problem.layout, *model.space.surface()))
