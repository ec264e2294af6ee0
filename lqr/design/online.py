"""The controller that follows the plan of a scene and makes it again, on the full plant from tick to tick."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.constrained.online import Ticks, carried_ticks, make_program
from softgrasp.lqr.constrained.plan import Plan
from softgrasp.lqr.constrained.run import STEPS, run_inputs
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.scene import control_of, given_force
from softgrasp.lqr.loop.controller import Controller, layout_hash
from softgrasp.lqr.loop.small import galerkin
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.replan import Replanned
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.lqr.spectrum.sampled import Sampling

if TYPE_CHECKING:  # observers are not imported where a scene has none
    from softgrasp.lqr.design.observer import ObservedControl
    from softgrasp.lqr.observer.tube import TubeTrajectory


@dataclass(frozen=True)
class PlannedOnline:
    """The controller that follows a plan and makes it again at every interval, on the full plant from tick to tick.

    With an observer under noise and disturbances, else without and with as many ticks as the run of the plan has steps.
    """

    controller: Controller
    """The controller that a robot runs."""
    covariance: Array | None
    """Covariance of the place of every node around the planned one [m2], (nodes, d, d); None without an observer."""
    times: Array
    """Times of the run [s], (count,)."""
    gaps: Array
    """Distance of body and obstacle at these times, negative where they overlap [m], (count, obstacles)."""
    log: tuple[Replanned, ...]
    """How every interval began."""


@dataclass(frozen=True)
class Known:
    """The tissue in the modes from which the bound of the plan's error is computed."""

    surface: Surface  # nodes of the boundary, and which of them keep gaps
    tissue: ModalTissue  # all modes, or the lowest with static answers
    shapes: Array  # these modes and answers, local rows (n_local, k)
    loop: ModalLoop  # the plant in all modes, or in the lowest


def planned_controller(
    design: Design,
    plan: Plan,
    shapes: Array,
    observed: ObservedControl | None = None,
    rate: float | None = None,
) -> Controller:
    """The controller that follows a plan and makes it again at every interval, from the observer's estimate or its own.

    Collective.

    Args:
        design: the optimal feedback, which keeps the plant near to the plan.
        shapes: modes and answers of the tissue that the plan's plant was reduced from, local rows (n_local, k).
        observed: observer of the scene; None: the tissue is carried from the measured hand.
        rate: ticks a second without an observer; None: those of the scene.

    Raises ControlError: the plan does not keep everything, an interval is no multiple of the tick, or the loop is not
    stable.
    """
    problem, n_s = design.problem, design.problem.layout.n_s
    own = plan.horizon.plant.tissue.of
    assert own is not None
    if observed is None:
        plant, small = galerkin(problem, shapes @ own)
        x_bar, u_bar = plant.rest_at(design.target.state.q_s)
        period = 1 / (rate or control_of(design.model).loop.rate)
        base = Controller(
            small.reduce_gain(problem, design.gain), x_bar, u_bar, plant, period,
            None, scene_hash(design.model.scene), layout_hash(problem.layout),
            {"scene": design.model.scene.name, "method": "optimal gain around a plan", "N": plant.N},
        )  # fmt: skip
        radius = design.gain_check.ticks.controller(base, Sampling(base.period, 1))
        if not radius.value < 1:
            raise ControlError(f"the loop from tick to tick is not stable, its spectral radius is {radius.value:.3g}")
        mixed, ticks = own, carried_ticks(base)
    else:
        base, filter_ = observed.controller, observed.reduced.filter
        mixed, ticks = observed.reduced.mixed, Ticks(filter_.A, filter_.B, filter_.f)
    eta = own.T @ mixed  # from the tissue of the controller to that of the plan
    T = scipy.linalg.block_diag(np.eye(2 * n_s), eta, eta)
    force, loop = given_force(design.model, n_s), design.actuation.bound(n_s)
    limits = loop if force is None else force if loop is None else np.minimum(force, loop)
    program = make_program(plan, T, base.x_bar, ticks, base.period)
    return replace(base, limits=limits, planner=program)


def run_online(
    design: Design, plan: Plan, known: Known, observed: ObservedControl | None
) -> tuple[PlannedOnline | None, str]:
    """The planned controller on the full plant for the horizon, or None and why there is none. Collective."""
    from softgrasp.lqr.observer.judge import make_ticks
    from softgrasp.lqr.observer.sensors import Noise, make_disturbance, make_sensors
    from softgrasp.lqr.observer.tube import node_covariance, node_rows, run_tube

    problem = design.problem
    if problem.system.two_way:
        return None, "the hand feels the tissue; a plan is made again online for one that does not"
    if known.surface.rigid is not None:
        return None, "the hand turns; a plan is made again online for one that does not"
    try:
        controller = planned_controller(design, plan, known.shapes, observed)
    except ControlError as error:
        return None, str(error)
    runs = controller
    if observed is None:
        slow = (
            plan.horizon.plant.parts * STEPS / plan.horizon.plant.grid
        )  # ticks a second: between them nothing happens
        if slow < 1 / controller.period:
            runs = planned_controller(design, plan, known.shapes, rate=slow)
        sensors, nothing = make_sensors(problem, [], Noise(0.0, 0.0)), make_disturbance(problem, 0.0, 0.0, None)
        ticks = make_ticks(problem, known.loop, sensors, nothing, runs.period)
    else:
        ticks = observed.ticks

    whole = known.loop.complete

    def run() -> tuple[TubeTrajectory, Array | None]:
        plant, program = plan.horizon.plant, runs.planner
        assert program is not None
        # a hand that feels no tissue moves the same in any modes; the full plant follows below
        rows = node_rows(known.tissue, plant.n_s) if whole else np.zeros((0, plant.n_s, len(ticks.A)))
        every = max(1, program.every // (plant.parts * STEPS))
        count = plan.horizon.steps * program.every
        found = run_tube(runs, ticks, rows, count, every, None if observed is None else 0)
        return found, None if observed is None else node_covariance(rows, observed.judged)

    found, covariance = on_root(problem.layout.comm, run)
    if not whole:
        body = run_inputs(
            problem, design.solution, plan, known.surface, design.start, design.target, found.inputs, runs.period
        )
        return PlannedOnline(controller, None, body.times, body.gaps, found.log), ""
    gaps = on_root(problem.layout.comm, lambda: plan.task.gaps(plan.task.places + found.moved, found.times))
    return PlannedOnline(controller, covariance, found.times, gaps, found.log), ""
