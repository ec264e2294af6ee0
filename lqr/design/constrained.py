"""The plan of a scene past its obstacles, and its run on the full plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.model.surface import refuse_within
from softgrasp.fem.obstacles import make_obstacles
from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.constrained.horizon import held_plant
from softgrasp.lqr.constrained.plan import Plan, make_plan
from softgrasp.lqr.constrained.pulse import PulseError
from softgrasp.lqr.constrained.rest import known_tissue, run_rest
from softgrasp.lqr.constrained.rows import Limits
from softgrasp.lqr.constrained.run import PlanRuns, run_inputs, run_plan
from softgrasp.lqr.constrained.task import Task
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface, modal_tissue, require_plannable
from softgrasp.lqr.design.body import body_surface
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.linearise import finite_problem
from softgrasp.lqr.design.online import Known, PlannedOnline, run_online
from softgrasp.lqr.design.scene import control_of, given_force, problem
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import rest
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, ModalLoop

if TYPE_CHECKING:  # observers are not imported where a scene has none
    from softgrasp.lqr.design.observer import ObservedControl

FINITE_STEPS = 5  # of a run of finite strain in each part of an interval: 25 ms at the defaults
SETTLED = 5.0  # time constants of the hand alone that the first horizon lasts: 0.7 % of the way are left
AT_REST = 1e-9  # of the body: a start so near to equilibrium is one
SWINGS = "a plan starts with the tissue in equilibrium; set time.start = 'equilibrium'"


@dataclass(frozen=True)
class PlannedControl:
    """What a scene's ``[control.constraints]`` asks for."""

    plan: Plan
    """The plan, made on the reduced plant."""
    runs: PlanRuns
    """Plan and optimal feedback on the full plant."""
    surface: Surface
    """Nodes of the body on its boundary, and which of them keep gaps."""
    names: tuple[str, ...]
    """Of the obstacles."""
    online: PlannedOnline | None = None
    """The controller that plans again at every interval, on the full plant; None where there is none."""
    reason: str = ""
    """Why there is no such controller; empty where there is one."""
    run_error: float | None = None
    """Part of the margin for the steps of the runs behind it, proved [m]; None where all modes are known."""


@dataclass(frozen=True)
class PlanSizes:
    """The quadratic program of the first horizon."""

    N: int  # states of the reduced plant
    intervals: int  # of the horizon
    grid: float  # length of an interval [s]
    variables: int  # forces of all intervals
    rows: int  # gaps of all nodes at all instants, and limits


@dataclass(frozen=True)
class FinitePlan:
    """A plan of the linear plant on that of finite strain."""

    gaps: Array
    """Least distance of body and obstacle, negative where they overlap [m], (obstacles,); empty where it failed."""
    error: float
    """Largest distance of a node from where the linear plant has it at the same instant [m]."""
    reason: str = ""
    """Why the run failed; else empty."""


def run_plan_finite(design: Design, model: Model, planned: PlannedControl) -> FinitePlan:
    """The inputs of a plan on the plant of finite strain, from the same start. Collective.

    Raises SolverError: there is no equilibrium under gravity.
    """
    problem, target = finite_problem(design.problem, model.system, design.target)
    start = rest(model.system, deformed=model.scene.time.start == "equilibrium")
    plan, surface = planned.plan, planned.surface
    each = plan.horizon.plant.parts * FINITE_STEPS
    inputs, dt = np.repeat(plan.inputs, each, axis=0), plan.horizon.plant.grid / each
    try:
        run = run_inputs(problem, design.solution, plan, surface, start, target, inputs, dt)
    except SolverError as error:  # it diverges, or leaves what the law describes
        return FinitePlan(np.zeros(0), np.inf, str(error))
    # with the same steps, whose error is that of both
    linear = run_inputs(design.problem, design.solution, plan, surface, design.start, design.target, inputs, dt)
    return FinitePlan(run.least, float(np.linalg.norm(surface.of(run.body - linear.body), axis=2).max()))


def plan_control(
    design: Design,
    watch: Stopwatch,
    notify: Callable[[int, int], None] | None = None,
    observed: ObservedControl | None = None,
    online: bool = True,
    estimated: float = 0.0,
) -> PlannedControl:
    """Plan past the obstacles of a scene, within its limits, and run it on the full plant. Collective.

    Args:
        design: the optimal feedback of the scene.
        watch: records the seconds of "bound", "plan" and "plan run".
        notify: called with the number of steps of the full plant done and in all.
        observed: the observer of the scene, whose feedback keeps the plant near to the plan.
        online: whether the controller that plans again is made and run.
        estimated: further margin, for the error of the linear plant [m].

    Raises:
        ControlError: the plant has no plan, the target keeps no gap or limit, or a key is missing.
        ResourceError: the quadratic program does not fit in memory.
        SolverError: a solve of the full plant failed.
    """
    plant = design.problem
    obstacles = make_obstacles(design.model.scene, plant.layout.dimension)
    given = control_of(design.model).constraints
    assert given is not None
    surface, whole = body_surface(design.model), plant.layout.n_e <= DENSE_LIMIT
    near = surface.keeping()
    start = _at_rest(design)
    with watch.stage("bound"):
        require_plan(design.model)
        loop = observed.loop if observed is not None else ModalLoop(plant, DENSE_LIMIT if whole else None)
        if whole:
            tissue, shapes = modal_tissue(plant, near, loop), loop.plant.Phi
        else:
            tissue, shapes = known_tissue(plant, near)
        reduced = tissue.reduced(given.N // 2 - plant.layout.n_s, given.grid)
        limits = _limits(design)
        run_error = None if whole else 0.0
        error = np.full(near.nodes.shape, 0.0 if given.margin == "bound" else given.margin)
        if given.margin == "bound":
            most = np.abs(np.linalg.inv(plant.M_s)) @ (_force(limits) + np.abs(design.target.u))
            rest_of = None if whole else run_rest(plant, near, tissue, shapes, given.grid)
            if rest_of is not None:
                run_error = max(float((rest_of.error(i) @ most).max()) for i in range(len(rest_of.instants)))
            pulses = PulseError(tissue, reduced, given.grid, rest_of)
            error = on_root(plant.layout.comm, lambda: pulses.bound(most))
        noise, limits = _noise(given.noise, observed, tissue, limits)
    with watch.stage("plan"):
        on_grid = held_plant(plant, reduced, given.grid, given.parts)
        begin = np.zeros(on_grid.N)
        begin[: plant.layout.n_s] = start
        bodies, names = tuple(o.shape for o in obstacles), tuple(o.name for o in obstacles)
        penalty = None if given.penalty == "auto" else float(given.penalty)
        target = _places(plant, near, design)
        task = Task(
            begin, target, design.target.u, bodies, names, error, given.clearance + estimated, limits, noise,
            given.margin == "bound", penalty, tuple(o.path for o in obstacles),
            near.arms, None if near.rigid is None else design.target.state.q_s[plant.layout.dimension :],
            float(np.ptp(surface.nodes, axis=0).max()),
        )  # fmt: skip
        steps = first_horizon(design.model, plant)
        longest = None if given.horizon == "auto" else steps
        plan = on_root(plant.layout.comm, lambda: make_plan(on_grid, task, steps, longest))
    with watch.stage("plan run"):
        runs = run_plan(plant, design.solution, plan, surface, tissue, design.start, design.target, notify)
    if not online:
        return PlannedControl(plan, runs, surface, names, run_error=run_error)
    with watch.stage("online"):
        robot, reason = run_online(design, plan, Known(surface, tissue, shapes, loop), observed)
    return PlannedControl(plan, runs, surface, names, robot, reason, run_error)


def _noise(
    deviations: float, observed: ObservedControl | None, tissue: ModalTissue, limits: Limits
) -> tuple[Array | float, Limits]:
    """Margin of every node for noise [m], and the limits with room for it.

    Raises ControlError: the force has none.
    """
    if observed is None:
        return 0.0, limits
    from softgrasp.lqr.observer.tube import node_covariance, node_rows

    judged = observed.judged
    covariance = node_covariance(node_rows(tissue, len(judged.sd_inputs)), judged)
    sd = np.sqrt(np.maximum(np.einsum("jdd->jd", covariance), 0.0))
    if limits.force is not None:
        force = limits.force - deviations * judged.sd_inputs
        if not force.min() > 0:
            raise ControlError(
                f"{deviations:g} standard deviations of the force, {deviations * judged.sd_inputs.max():.3g} N, leave "
                "nothing of control.constraints.force; raise it, or lower control.constraints.noise"
            )
        limits = replace(limits, force=force)
    return deviations * sd, limits


def require_plan(model: Model) -> None:
    """See that a scene may have a plan, whatever its gain. Collective.

    Raises ControlError: it has none. Raises SceneError: an obstacle is within the body, whose boundary keeps gaps.
    """
    plant, given = problem(model), control_of(model)
    require_plannable(plant)
    if plant.system.two_way:
        if given.observer is not None:
            raise ControlError(
                "a plan with control.observer is made for a hand that does not feel the tissue; leave out "
                "effects.reaction, or control.observer"
            )
        if given.constraints is not None and given.constraints.speed is not None:
            raise ControlError(
                "control.constraints.speed limits a hand whose speed changes linearly between instants; one that feels "
                "the tissue swings between them: leave out speed, or effects.reaction"
            )
    given_force(model, plant.layout.n_s)
    if (surface := body_surface(model)).kept is None:
        refuse_within(model.space, make_obstacles(model.scene, plant.layout.dimension), surface.nodes, 0.0)
    if model.system.gravity is not None and model.scene.time.start != "equilibrium":
        raise ControlError(SWINGS)


def first_horizon(model: Model, plant: RiccatiProblem) -> int:
    """Intervals of the first horizon: those of the scene, or until the hand without tissue has settled."""
    given = control_of(model).constraints
    assert given is not None
    if given.horizon != "auto":
        return max(1, int(np.ceil(given.horizon / given.grid - 1e-9)))
    n_s = plant.layout.n_s
    A, B = np.eye(2 * n_s, k=n_s), np.vstack([np.zeros((n_s, n_s)), np.linalg.inv(plant.M_s)])
    C = np.hstack([plant.C_s, np.zeros_like(plant.C_s)])
    X = scipy.linalg.solve_continuous_are(A, B, C.T @ plant.Q @ C, plant.R)
    slowest = -float(np.linalg.eigvals(A - B @ np.linalg.solve(plant.R, B.T @ X)).real.max())
    return max(1, int(np.ceil(SETTLED / (slowest * given.grid))))


def plan_sizes(model: Model, boundary: int | None = None) -> PlanSizes | None:
    """Variables and rows of the plan before it is made; None where the scene has none. Collective.

    ``boundary``: nodes on the boundary of the mesh that the model is a coarser copy of; None: the model is no copy.
    """
    given = control_of(model).constraints
    if given is None:
        return None
    plant = problem(model)
    steps, n_s = first_horizon(model, plant), plant.layout.n_s
    if boundary is None:
        nodes = len(body_surface(model).keeping().nodes)
    else:
        nodes = boundary if given.body == "boundary" else len(given.body)
    gaps = len(model.scene.obstacle or []) * (given.parts + 1) * nodes
    hand = 2 * n_s * sum(limit is not None for limit in (given.force, given.speed, given.jump))
    return PlanSizes(given.N, steps, given.grid, n_s * steps, steps * (gaps + hand))


def _at_rest(design: Design) -> Array:
    """Start of the hand from its target; raises ControlError where the tissue does not start in equilibrium."""
    off, layout = design.start - design.target.state, design.problem.layout
    swing = float(total(layout.comm, np.array([off.z @ off.z + off.v_z @ off.v_z]))[0]) ** 0.5
    if swing > AT_REST * layout.extent or off.v_s.any():
        raise ControlError(SWINGS)
    return off.q_s


def _limits(design: Design) -> Limits:
    """Of the scene, one number per axis. Raises ControlError: their number does not fit, or the loop cuts them."""
    given, n_s = control_of(design.model).constraints, design.problem.layout.n_s
    assert given is not None
    force = given_force(design.model, n_s)
    bound = design.actuation.bound(n_s)
    if bound is not None and (force is None or (force > bound).any()):
        raise ControlError(
            f"control.loop.limit cuts the forces at {bound.min():.4g} N, and a plan needs all of its own; set "
            "control.constraints.force to no more than that"
        )
    return Limits(force, given.speed, given.jump)


def _force(limits: Limits) -> Array:
    assert limits.force is not None
    return limits.force


def _places(plant: RiccatiProblem, surface: Surface, design: Design) -> Array:
    """Nodes of the boundary at the target [m], (nodes, d). Collective."""
    state, d = design.target.state, plant.layout.dimension
    z = np.zeros((len(surface.nodes), d))
    z[surface.first : surface.first + len(surface.rows)] = state.z[surface.rows]
    return np.asarray(surface.nodes + surface.with_hand(state.q_s) + total(plant.layout.comm, z))
