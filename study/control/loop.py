"""The closed loop of a scene: full plant under the optimal and the reduced gains, and the controllers as files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.columns import farthest
from softgrasp.fem.errors import SolverError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.controller import Controller, layout_hash, save_gain
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopTrajectory
from softgrasp.lqr.loop.small import ReducedLoop, ReducedTrajectory
from softgrasp.lqr.loop.small_plant import m_orthonormal, project
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.coordinates import gain_of
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import outputs
from softgrasp.lqr.reduced.riccati import norm
from softgrasp.lqr.spectrum.modal_loop import SampledRadius
from softgrasp.lqr.spectrum.sampled import Sampling
from softgrasp.study.control.solve import Design, actuation, largest_radius, loop_words
from softgrasp.study.control.sweep import MANY_STATES, SweptBasis, fast_order
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.pictures.loop import move_steps

SETTLED = 6.0  # time constants of the slower hand pole after which 0.3 % of the way are left
LONGEST = 20  # times the steps of the scene that a run without [control] may take to settle
TICKS = 1000  # behind the time of one tick of the controller
NOTHING = 1e-12  # of the gain: rounding


@dataclass(frozen=True)
class LoopPlan:
    """How long the loop runs.

    Attributes:
        dt: time step [s].
        steps: number.
        settle: time after which a rigid body under this gain is at the target [s].
        note: why the scene's own end is not taken, or that it is too early; else empty.
    """

    dt: float
    steps: int
    settle: float
    note: str = ""


@dataclass(frozen=True)
class LoopRuns:
    """All closed-loop runs.

    Attributes:
        plan: times.
        full: under the optimal gain.
        to_come: cost still to come at the end, from the Riccati solution.
        reduced: under the best stable gain of each method: (title, N) and the run, or why it failed.
        small: the controller's own small plant under its gain.
        limits: of the inputs [N, N m], inf for none; None without any.
    """

    plan: LoopPlan
    full: LoopTrajectory
    to_come: float
    reduced: dict[str, tuple[str, int, LoopTrajectory | str]]
    small: ReducedTrajectory | None
    limits: Array | None = None


@dataclass(frozen=True)
class MadeController:
    """The small controller of a scene.

    Attributes:
        controller: what a robot runs.
        name: basis that its gain came from.
        tick: seconds of one tick, median.
        radius: of the plant under it from tick to tick, at the period, step and delay of the scene.
    """

    controller: Controller
    name: str
    tick: float
    radius: SampledRadius


def plan(model: Model, found: Design, own_end: bool) -> LoopPlan:
    """Steps of the scene; without a [control] table as many more as the move needs. Not collective."""
    scene, K = model.scene, found.solution.K_s
    n_s = model.system.layout.n_s
    dt = scene.time_end / scene.time.steps
    A = np.zeros((2 * n_s, 2 * n_s))
    A[:n_s, n_s:] = np.eye(n_s)
    A[n_s:] = np.linalg.solve(found.problem.M_s, K)
    slowest = -float(np.linalg.eigvals(A).real.max())
    settle = SETTLED / slowest if slowest > 0 else scene.time_end
    needed = int(np.ceil(settle / dt))
    steps = scene.time.steps
    if needed <= steps:
        return LoopPlan(dt, steps, settle)
    if own_end:
        note = f"the loop ends at t = {scene.time_end:g} s, but this gain needs about {settle:.2g} s; raise "
        return LoopPlan(dt, steps, settle, note + "time.end, or control.Q for a faster move")
    longer = min(needed, LONGEST * steps)
    note = f"the loop runs {longer} steps to t = {longer * dt:.3g} s; at t = {scene.time_end:g} s it would still move"
    return LoopPlan(dt, longer, settle, note)


def make_controller(model: Model, found: Design, swept: Sequence[SweptBasis]) -> tuple[MadeController | None, str]:
    """The best certified a-priori gain of a small order as a controller; None and why when there is none. Collective.

    Its states are [q_s, v_s, eta, eta'] with z = V eta, V the modes of the basis. The gain that is lifted by the filter
    W'z of these modes acts on them only, so that the small controller is the gain that was judged.
    """
    problem, layout = found.problem, model.system.layout
    n = layout.n_local
    basis = next((s for s in swept if s.name == "structured"), None)
    best = None if basis is None else basis.best(fast_order(layout.n_s), 2 * layout.n_s + 2)
    if found.modal:
        name, gain = "modal", Gain.of(found.solution)
        # the factor spans the modes; what is dropped has 1e-12 of its largest column in X
        V = m_orthonormal(model.system.M_ee, found.solution.Z_v, 1e-6)
    elif blind(found):
        name, gain = "hand alone", Gain.of(found.solution)
        V = np.zeros((n, 0))
    elif basis is None or basis.family is None or best is None:
        return None, "no a-priori gain of small order with tissue in it is certified to be stable"
    else:
        name, gain = basis.name, gain_of_basis(found, basis, best.N)
        V = basis.family.at(best.N).U.tall[n:, -((best.N - 2 * layout.n_s) // 2) :]
    plant, shapes = project(problem, V)
    K = shapes.reduce_gain(problem, gain)
    loop = None if model.scene.control is None else model.scene.control.loop
    bound = actuation(model).bound(layout.n_s)
    x_bar, u_bar = plant.rest_at(found.target.state.q_s)
    controller = Controller(
        K,
        x_bar,
        u_bar,
        plant,
        1e-3 if loop is None else 1 / loop.rate,
        bound,
        scene_hash(model.scene),
        layout_hash(layout),
        {"scene": model.scene.name, "method": name, "N": plant.N},
    )
    law = found.judge.law
    if law is None or not law.every:  # the scene's own law acts within the step, which no robot can
        law = Sampling(controller.period, 1)
    radius = found.judge.ticks.controller(controller, law)
    if not radius.value < largest_radius(found.modal):
        return None, f"{loop_words(law)}, its loop has the spectral radius {radius.value:.3g}, which must be below 1"
    return MadeController(controller, name, layout.comm.bcast(_tick(controller)), radius), ""


def blind(found: Design) -> bool:
    """Whether the optimal gain is one of the hand alone: the outputs see nothing of the tissue. Collective."""
    problem, K = found.problem, gain_of(found.solution)
    part = Block(np.zeros_like(K.hand), K.tall)
    return norm(problem, part) <= NOTHING * norm(problem, K)


def gain_of_basis(found: Design, basis: SweptBasis, N: int) -> Gain:
    """K_hat of one order as blocks. Collective."""
    n, K = found.problem.layout.n_local, basis.reduced(found.problem, N).gain
    return Gain(np.ascontiguousarray(K.hand.T), K.tall[:n], K.tall[n:])


def _tick(controller: Controller) -> float:
    """Median seconds of a tick of ten."""
    q, v = np.zeros(controller.n_s), np.zeros(controller.n_s)
    times = []
    for _ in range(TICKS // 10):
        begin = time.perf_counter()
        for _ in range(10):
            controller.step(q, v)
        times.append((time.perf_counter() - begin) / 10)
    controller.reset()
    return float(np.median(times))


def save_controllers(model: Model, found: Design, made: MadeController | None, out: Path) -> list[Path]:
    """controller.npz for the robot, gain.npz of full order. Collective."""
    files = []
    layout = model.system.layout
    if made is not None and layout.comm.rank == 0:
        files.append(made.controller.save(out / "controller.npz"))
    gain = save_gain(out / "gain.npz", Gain.of(found.solution), found.target.state, layout, scene_hash(model.scene))
    return [*files, gain]


def run_loops(
    model: Model,
    found: Design,
    swept: Sequence[SweptBasis],
    made: MadeController | None,
    timing: LoopPlan,
    frames: Frames,
    notify: Callable[[int, int], None] | None = None,
) -> LoopRuns:
    """Full plant under the optimal gain with frames, then under the best stable gain of each method. Collective.

    Raises:
        SolverError: the loop under the optimal gain diverges.
    """
    problem, scene, law = found.problem, model.scene, actuation(model)
    others = [] if found.modal else best_gains(swept, model.system.layout)
    runs, done = (len(others) + 1) * timing.steps, 0

    def progress(run: Any) -> None:
        if notify is not None:
            notify(done + run.reached, runs)

    shown = move_steps(timing.steps, timing.dt, timing.settle, 3 if frames.few else scene.output.frames)
    frames.chosen = set(shown)
    loop = ClosedLoop(problem, timing.dt, scene.time.solver, scene.time.rtol, scene.time.reproducible)
    try:
        most = largest_cost(found, timing)
        options = LoopOptions(frames=shown, frame=frames, progress=progress, most=most)
        full = loop.run(Gain.of(found.solution), found.target, timing.steps, law, found.start, options)
        reduced: dict[str, tuple[str, int, LoopTrajectory | str]] = {}
        for basis, N in others:
            done += timing.steps
            gain = gain_of_basis(found, basis, N)
            run: LoopTrajectory | str
            try:
                options = LoopOptions(progress=progress, most=most)
                run = loop.run(gain, found.target, timing.steps, law, found.start, options)
            except SolverError as error:  # limits or sampling may upset what the continuous law stabilises
                run = str(error)
            reduced[basis.name] = (basis.title, N, run)
    finally:
        loop.destroy()
    to_come = predicted_cost(problem, found.solution, full.final - found.target.state)
    small, bound = small_run(model, found, made, timing, law), law.bound(problem.layout.n_s)
    return LoopRuns(timing, full, to_come, reduced, small, bound)


def largest_cost(found: Design, timing: LoopPlan) -> float:
    """A thousand times what the optimal loop and one that does nothing would pay. Collective."""
    y = outputs(found.problem, found.error)[:, 0]
    return 1e3 * (found.judge.optimal + timing.dt * timing.steps * float(y @ found.problem.Q @ y))


def best_gains(swept: Sequence[SweptBasis], layout: BlockLayout) -> list[tuple[SweptBasis, int]]:
    """The best stable order of every method, a priori that of the controller; of a large plant that one only."""
    limits = {"structured": fast_order(layout.n_s)}
    fine = [(s, best.N) for s in swept if (best := s.best(limits.get(s.name))) is not None]
    return fine if layout.states <= MANY_STATES else [(s, N) for s, N in fine if s.name == "structured"]


def small_run(
    model: Model, found: Design, made: MadeController | None, timing: LoopPlan, law: Actuation
) -> ReducedTrajectory | None:
    """The controller's plant under its gain, as the robot's own forecast. Not collective but for the start."""
    if made is None:
        return None
    c, problem = made.controller, found.problem
    start = c.plant.rest_at(np.zeros(c.n_s))[0]
    if model.scene.time.start != "equilibrium":
        start[2 * c.n_s :] = 0.0
    try:
        return ReducedLoop(c.plant, timing.dt).run(
            c.K, (c.x_bar, c.u_bar), timing.steps, (problem.Q, problem.R), law, start
        )
    except SolverError:
        return None


def distance(run: LoopTrajectory | ReducedTrajectory, found: Design) -> Array:
    """Distance of the farthest output to its target at every instant [m], (steps + 1,). Not collective."""
    return farthest(run.outputs, found.target.y, found.problem.columns)


def open_loop(found: Design) -> Block:
    """No feedback at all, transposed. Not collective."""
    K = gain_of(found.solution)
    return Block(np.zeros_like(K.hand), np.zeros_like(K.tall))
