"""A plan run on the full plant by the midpoint rule: gaps of the whole body at every step, and what the run cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.constrained.plan import Plan
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.drive import OpenDrive
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopRun, LoopTrajectory
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.target import Target

STEPS = 25  # of a run in each part of an interval: 5 ms at the defaults


@dataclass(frozen=True)
class BodyRun:
    """The body in a run of the full plant."""

    times: Array  # [s], (steps + 1,)
    body: Array  # places of the nodes on the boundary [m], (steps + 1, nodes, d)
    inputs: Array  # [N], (steps, n_s)
    v_s: Array  # velocity of the hand [m/s], (steps + 1, n_s)
    gaps: Array  # distance of body and obstacle, negative where they overlap [m], (steps + 1, obstacles)
    cost: float  # J, with what the optimal feedback pays after the end

    @property
    def least(self) -> Array:
        """Least gap to each obstacle [m], (obstacles,)."""
        return np.asarray(self.gaps.min(axis=0))

    @property
    def times_least(self) -> Array:
        """Times of the least gaps [s], (obstacles,)."""
        return np.asarray(self.times[self.gaps.argmin(axis=0)])


def watching(problem: RiccatiProblem, surface: Surface) -> RiccatiProblem:
    """The problem with the displacement of every free node on the boundary as further outputs without weight."""
    n_s, d = problem.layout.n_s, problem.layout.dimension
    C_z = np.zeros((problem.layout.n_local, d * surface.free), order="F")
    for i, rows in enumerate(surface.rows, surface.first):
        C_z[rows, d * i + np.arange(d)] = 1.0
    rigid = surface.rigid
    hand = np.tile(np.eye(d, n_s), (surface.free, 1)) if rigid is None else rigid[: surface.free].reshape(-1, n_s)
    C_s = np.vstack([problem.C_s, hand])
    Q = scipy.linalg.block_diag(problem.Q, np.zeros((d * surface.free,) * 2))
    return replace(problem, C_s=C_s, C_z=np.hstack([problem.C_z, C_z]), Q=Q, columns=())


@dataclass(frozen=True)
class PlanRuns:
    """Plan and optimal feedback on the full plant, from the same start."""

    planned: BodyRun  # under the inputs of the plan
    free: BodyRun  # under the optimal feedback, which knows no obstacle and no limit
    dt: float  # time step [s]
    reduction_error: float  # what the reduced plant leaves out of this plan, at the instants of its rows [m]
    step_error: float  # what the midpoint steps of the run change at these instants [m]


def run_plan(
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    plan: Plan,
    surface: Surface,
    tissue: ModalTissue,
    start: PlantState,
    target: Target,
    notify: Callable[[int, int], None] | None = None,
) -> PlanRuns:
    """Run the full plant for the horizon of a plan under its inputs and under the optimal feedback.

    Collective.

    Args:
        solution: optimal feedback, and the cost that is still to come at the end.
        surface: nodes of the body on its boundary.
        tissue: all modes of the plant, at the nodes that keep gaps.
        start: state at t = 0.
        target: state at rest.
        notify: called with the number of steps done and in all.

    Raises SolverError: a solve failed.
    """
    plant = plan.horizon.plant
    inputs = plan.inputs
    dt, each = plant.grid / (plant.parts * STEPS), plant.parts * STEPS
    steps = len(inputs) * each
    loop = ClosedLoop(watching(problem, surface), dt)
    runs: list[LoopTrajectory] = []
    options = LoopOptions(
        progress=lambda run: notify(len(runs) * steps + run.reached, 2 * steps) if notify is not None else None
    )
    try:
        watched = target_of(loop.problem, target)
        drive = OpenDrive(loop.plant, np.repeat(inputs, each, axis=0))
        run = LoopRun(loop, drive, start, steps, options, watched)
        run.execute()
        runs.append(run.trajectory(Actuation()))
        runs.append(loop.run(solution.gain, watched, steps, Actuation(), start, options))
    finally:
        loop.destroy()
    planned, free = (body_run(problem, solution, plan, surface, run, target) for run in runs)
    acceleration = (inputs - target.u) @ plant.B[plant.n_s : 2 * plant.n_s].T
    exact, reduced, off_hand = (
        np.einsum("jdm,kim->kijd", seen, t.answer(acceleration, plant.grid, plant.parts))
        for t, seen in ((tissue, tissue.seen), (plant.tissue, plant.tissue.seen), (tissue, tissue.relative))
    )
    at = (np.arange(len(inputs))[:, None] * each + np.arange(plant.parts + 1) * STEPS).ravel()
    hand, places = surface.keeping().with_hand(runs[0].q_s[at] - target.state.q_s), plan.task.places
    off = surface.of(planned.body)[at] - (places + hand) - off_hand.reshape(len(at), *places.shape)
    return PlanRuns(planned, free, dt, _largest(exact - reduced), _largest(off))


def run_inputs(
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    plan: Plan,
    surface: Surface,
    start: PlantState,
    target: Target,
    inputs: Array,
    dt: float,
) -> BodyRun:
    """Run a plant, one of finite strain for example, under given inputs, those of a plan for example. Collective.

    Args:
        solution: optimal feedback of the linear plant, and the cost that is still to come at the end.
        surface: nodes of the body on its boundary.
        start: state at t = 0.
        target: state of this plant at rest.
        inputs: of every step [N], (steps, n_s).
        dt: time step [s].

    Raises SolverError: a solve failed.
    """
    loop = ClosedLoop(watching(problem, surface), dt)
    try:
        run = LoopRun(
            loop, OpenDrive(loop.plant, inputs), start, len(inputs), LoopOptions(), target_of(loop.problem, target)
        )
        run.execute()
        return body_run(problem, solution, plan, surface, run.trajectory(Actuation()), target)
    finally:
        loop.destroy()


def _largest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def target_of(problem: RiccatiProblem, target: Target) -> Target:
    """The target with the outputs of the boundary. Collective."""
    tissue = total(problem.layout.comm, problem.C_z.T @ target.state.z)
    return Target(target.state, target.u, problem.C_s @ target.state.q_s + tissue)


def body_run(
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    plan: Plan,
    surface: Surface,
    run: LoopTrajectory,
    target: Target,
) -> BodyRun:
    """Places, gaps and cost of a run of the watched plant. Collective."""
    moved = run.outputs[:, len(problem.Q) :].reshape(len(run.times), -1, problem.layout.dimension)
    shape = len(run.times), len(surface.nodes) - surface.free, problem.layout.dimension
    held = np.broadcast_to(surface.with_hand(run.q_s)[:, -shape[1] :] if shape[1] else np.zeros(shape), shape)
    body = surface.nodes + np.concatenate([moved, held], axis=1)

    to_come = predicted_cost(problem, solution, run.final - target.state)
    apart = on_root(problem.layout.comm, lambda: plan.task.gaps(surface.of(body), run.times))
    return BodyRun(run.times, body, run.inputs, run.v_s, apart, float(run.cost[-1]) + to_come)
