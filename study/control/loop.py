"""The closed loop of a scene: full plant under the optimal and the reduced gains, and the controllers as files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.lqr.design.controller import CertifiedController
from softgrasp.lqr.design.duration import LoopPlan, largest_cost
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains, Notify, best_gains
from softgrasp.lqr.loop.controller import Controller, save_gain
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions
from softgrasp.study.control.result import LoopRuns, ReducedLoopRun
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.pictures.shapes import move_steps

TICKS = 1000  # behind the time of one tick of the controller


def tick_seconds(controller: Controller) -> float:
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


def save_controllers(design: Design, controller: CertifiedController | None, out: Path) -> list[Path]:
    """controller.npz for the robot, gain.npz of full order. Collective."""
    files, layout = list[Path](), design.problem.layout
    if controller is not None and layout.comm.rank == 0:
        files.append(controller.controller.save(out / "controller.npz"))
    return [
        *files,
        save_gain(out / "gain.npz", design.gain, design.target.state, layout, scene_hash(design.model.scene)),
    ]


def run_loops(
    design: Design, bases: Sequence[BasisGains], plan: LoopPlan, frames: Frames, notify: Notify | None = None
) -> LoopRuns:
    """Full plant under the optimal gain with frames, then under the best stable gain of each basis. Collective.

    Raises:
        SolverError: the loop under the optimal gain diverges.
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
