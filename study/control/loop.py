"""The closed loop of a scene: full plant under the optimal and the reduced gains, and the controllers as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model
from softgrasp.lqr.design.controller import CertifiedController
from softgrasp.lqr.design.duration import LoopPlan, largest_cost
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains, Notify, best_gains, fast_order
from softgrasp.lqr.design.scene import finite_problem
from softgrasp.lqr.loop.controller import Controller, save_gain
from softgrasp.lqr.loop.cost import overshoot, predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopTrajectory
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.target import rest
from softgrasp.study.control.result import ControlStudy, FiniteLoop, LoopRuns, ReducedLoopRun, a_priori
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.pictures.shapes import move_steps
from softgrasp.study.shell.timing import repeated

NEAR = 0.01  # of the way, which a loop that settles comes to
SHOWN_MODES = 20  # whose poles are drawn
TICKS = 1000  # behind the time of one tick of the controller


def tick_seconds(controller: Controller) -> float:
    """Median seconds of a tick of ten."""
    rest = np.zeros(controller.n_s)
    times = repeated(MPI.COMM_SELF, lambda: [controller.step(rest, rest) for _ in range(10)], TICKS // 10, np.inf)
    controller.reset()
    return float(np.median(times)) / 10


def save_controllers(
    design: Design, controller: CertifiedController | None, out: Path, target: PlantState
) -> list[Path]:
    """controller.npz for the robot, gain.npz of full order with x_bar. Collective."""
    files, layout = list[Path](), design.problem.layout
    if controller is not None and layout.comm.rank == 0:
        files.append(controller.controller.save(out / "controller.npz"))
    return [
        *files,
        save_gain(out / "gain.npz", design.gain, target, layout, scene_hash(design.model.scene)),
    ]


def run_finite(design: Design, model: Model, linear: LoopTrajectory, plan: LoopPlan, notify: Notify) -> FiniteLoop:
    """The optimal gain of the linear plant on that of finite strain, from the same start. Collective.

    ``linear`` is the run of the linear plant. Raises SolverError: there is no equilibrium under gravity.
    """
    scene, points = model.scene, model.system.points
    assert points is not None
    problem, target = finite_problem(design.problem, model.system, design.target)
    start = rest(model.system, deformed=scene.time.start == "equilibrium")
    options = LoopOptions(progress=lambda run: notify(run.reached, plan.steps), most=largest_cost(design, plan))
    loop = ClosedLoop(problem, plan.dt, scene.time.solver, scene.time.rtol, scene.time.reproducible)
    try:
        run = loop.run(design.gain, target, plan.steps, design.actuation, start, options)
    except SolverError as error:  # it diverges, or leaves what the law describes
        return FiniteLoop(points.law, None, target, str(error))
    finally:
        loop.destroy()
    away, expected = (np.linalg.norm(r.outputs - t.y, axis=1) for r, t in ((run, target), (linear, design.target)))
    reason = ""
    if away[-1] > max(NEAR * away[0], 2 * expected[-1]):
        reason = f"the outputs end {away[-1]:.3g} m from their target, on the linear plant {expected[-1]:.3g} m"
    excess = float(run.cost[-1] / linear.cost[-1] - 1) if linear.cost[-1] > 0 else 0.0
    past = overshoot(run.outputs, target.y), overshoot(linear.outputs, design.target.y)
    return FiniteLoop(points.law, run, target, reason, excess, *past)


def run_loops(
    design: Design, bases: Sequence[BasisGains], plan: LoopPlan, frames: Frames, notify: Notify | None = None
) -> LoopRuns:
    """Full plant under the optimal gain with frames, then under the best stable gain of each basis. Collective.

    Raises SolverError: the loop under the optimal gain diverges.
    """
    problem, scene, law = design.problem, design.model.scene, design.actuation
    others = [] if design.modal else best_gains(bases, problem.layout)
    total, done = (len(others) + 1) * plan.steps, 0

    def progress(run: Any) -> None:
        if notify is not None:
            notify(done + run.reached, total)

    shown = move_steps(plan.steps, plan.dt, plan.settle, 3 if frames.few else scene.output.frames)
    frames.chosen = set(shown)
    loop = ClosedLoop(problem, plan.dt, scene.time.solver, scene.time.rtol, scene.time.reproducible)
    reduced = []
    try:
        most = largest_cost(design, plan)
        options = LoopOptions(frames=shown, frame=frames, progress=progress, most=most)
        full = loop.run(design.gain, design.target, plan.steps, law, design.start, options)
        options = LoopOptions(progress=progress, most=most)
        for report in others:
            done += plan.steps
            if report.gain is None:
                continue
            try:
                run = loop.run(report.gain, design.target, plan.steps, law, design.start, options)
                reduced.append(ReducedLoopRun(report.method, report.N, run))
            except SolverError as error:  # limits or sampling may upset what the continuous law stabilises
                reduced.append(ReducedLoopRun(report.method, report.N, None, str(error)))
    finally:
        loop.destroy()
    to_come = predicted_cost(problem, design.solution, full.final - design.target.state)
    return LoopRuns(plan, full, to_come, tuple(reduced), law.bound(problem.layout.n_s))


def pole_sets(study: ControlStudy) -> dict[str, np.ndarray]:
    """Poles with the optimal and the a-priori gain and without any, on the lowest modes. Collective."""
    design, loop, basis = study.design, study.design.judge.loop, a_priori(study.bases)
    K = design.gain.block
    sets = {
        "without feedback": loop.poles(K.times(np.zeros((K.columns, K.columns)))),
        ("modal gain" if design.modal else "optimal gain"): loop.poles(K),
    }
    best = None if basis is None else basis.best(fast_order(design.problem.layout.n_s))
    if best is not None and best.gain is not None:
        sets[f"a-priori gain, $N = {best.N}$"] = loop.poles(best.gain.block)
    return {name: p[np.argsort(np.abs(p))][: 2 * SHOWN_MODES] for name, p in sets.items()}
