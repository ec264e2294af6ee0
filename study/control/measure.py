"""What ``softgrasp control`` runs and times: closed loops, ticks, reduced equations, gains re-tuned over a box."""

from __future__ import annotations

import timeit
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Model, SolverError, farthest, frame_count, on_root, scene_hash
from softgrasp.lqr import ControlError, Design, PlantState, RiccatiProblem, finite_problem, solve, solve_reduced
from softgrasp.lqr.design.controller import CertifiedController, NoController, certified_controller
from softgrasp.lqr.design.duration import LoopPlan, largest_cost
from softgrasp.lqr.design.orders import (
    BasisGains,
    Notify,
    best_gains,
    certified,
    course_of,
    fast_order,
    reduce_gains,
    with_bounds,
)
from softgrasp.lqr.loop.controller import Controller, save_gain
from softgrasp.lqr.loop.cost import overshoot, predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopTrajectory
from softgrasp.lqr.plant.target import rest
from softgrasp.lqr.reduced.bases import A_PRIORI, BasisFamily
from softgrasp.lqr.reduced.retune import Materials, RetunedGain, Retuner, retuned_gain
from softgrasp.lqr.reduced.riccati import GainCheck, GainReport
from softgrasp.reduction import grid_of, materials_at, outside
from softgrasp.study.control.result import (
    ControlStudy,
    FiniteLoop,
    GainStudy,
    LoopRuns,
    ReducedLoopRun,
    Retuned,
    TouchingLoop,
)
from softgrasp.study.pictures import Frames, move_steps
from softgrasp.study.shell import repeated

NEAR = 0.01  # of the way, which a loop that settles comes to
SHOWN_MODES = 20  # whose poles are drawn
TICKS = 1000  # behind the time of one tick of the controller
SOLUTIONS = 3  # of a reduced equation, the fastest counts
REPEATS = 5  # of a re-tuning, the best counts
BOX_STATES = 30_000  # above, nine more full solutions would take minutes


def gain_study(design: Design, bases: Sequence[BasisGains], *notes: str) -> GainStudy:
    """With the small controller and the time of its tick, or with a note why there is none. Collective."""
    controller: CertifiedController | None = None
    tick = float("nan")
    try:
        controller = certified_controller(design, a_priori(bases))
        tick = design.problem.layout.comm.bcast(tick_seconds(controller.controller))
    except NoController as error:
        notes = (*notes, f"There is no small controller: {error}")
    return GainStudy(design, tuple(bases), controller, tick, tuple(filter(None, notes)))


def a_priori(bases: Sequence[BasisGains]) -> BasisGains | None:
    """The gains of the basis that needs no P; None where there are none."""
    return next((b for b in bases if b.name == A_PRIORI), None)


def tick_seconds(controller: Controller) -> float:
    """Median seconds of a tick of ten."""
    at_rest = np.zeros(controller.n_s)
    ten = repeated(MPI.COMM_SELF, lambda: [controller.step(at_rest, at_rest) for _ in range(10)], TICKS // 10)
    controller.reset()
    return float(np.median(ten)) / 10


def save_controllers(study: GainStudy, out: Path, target: PlantState) -> list[Path]:
    """controller.npz, observer.npz and plan.npz for the robot, gain.npz of full order with x_bar. Collective."""
    design, layout = study.design, study.design.problem.layout
    files = []
    if study.controller is not None and layout.comm.rank == 0:
        files.append(study.controller.controller.save(out / "controller.npz"))
    if study.observed is not None and layout.comm.rank == 0:
        files.append(study.observed.observed.controller.save(out / "observer.npz"))
    online = study.planned.planned.online if isinstance(study, ControlStudy) and study.planned is not None else None
    if online is not None and layout.comm.rank == 0:
        files.append(online.controller.save(out / "plan.npz"))
    return [*files, save_gain(out / "gain.npz", design.gain, target, layout, scene_hash(design.model.scene))]


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
        return FiniteLoop(points.laws.name, None, target, str(error))
    finally:
        loop.destroy()
    away, expected = (np.linalg.norm(r.outputs - t.y, axis=1) for r, t in ((run, target), (linear, design.target)))
    reason = ""
    if away[-1] > max(NEAR * away[0], 2 * expected[-1]):
        reason = f"the outputs end {away[-1]:.3g} m from their target, on the linear plant {expected[-1]:.3g} m"
    excess = float(run.cost[-1] / linear.cost[-1] - 1) if linear.cost[-1] > 0 else 0.0
    past = overshoot(run.outputs, target.y), overshoot(linear.outputs, design.target.y)
    return FiniteLoop(points.laws.name, run, target, reason, excess, *past)


@contextmanager
def loop_of(design: Design, plan: LoopPlan, meets: Model | None) -> Iterator[ClosedLoop]:
    """The full plant with one factor for bounds and runs. Collective. ``meets``: gives the obstacles; None for none."""
    time = design.model.scene.time
    loop = ClosedLoop(design.problem, plan.dt, time.solver, time.rtol, time.reproducible, meets)
    try:
        yield loop
    finally:
        loop.destroy()


def run_loops(
    loop: ClosedLoop, design: Design, bases: Sequence[BasisGains], plan: LoopPlan, frames: Frames, notify: Notify
) -> LoopRuns:
    """Full plant under the optimal gain, with frames, and under the best stable gain of each basis. Collective.

    Where the scene has contact, the optimal gain runs into its obstacles too, and the frames are of that run.
    Raises SolverError: the loop under the optimal gain diverges.
    """
    problem, scene, law = design.problem, design.model.scene, design.actuation
    others = [] if design.modal else best_gains(bases, problem.layout)
    meets = loop.scene is not None
    total, done = (len(others) + 1 + meets) * plan.steps, 0

    def progress(run: Any) -> None:
        notify(done + run.reached, total)

    shown = move_steps(plan.steps, plan.dt, plan.settle, 3 if frames.few else frame_count(scene, problem.layout.n_e))
    frames.chosen = set(shown)
    options = LoopOptions(progress=progress, most=largest_cost(design, plan))
    reduced, touching = [], None
    filmed = replace(options, frames=shown, frame=frames)
    full = loop.run(design.gain, design.target, plan.steps, law, design.start, options if meets else filmed)
    if meets:
        done += plan.steps
        touching = _touching(design, full, partial(loop.run, options=replace(filmed, touching=True)))
    for report in others:
        done += plan.steps
        if report.gain is None:
            continue
        try:
            run = loop.run(report.gain, design.target, plan.steps, law, design.start, options)
            reduced.append(ReducedLoopRun(report.method, report.N, run))
        except SolverError as error:  # limits or sampling may upset what the continuous law stabilises
            reduced.append(ReducedLoopRun(report.method, report.N, None, str(error)))
    to_come = predicted_cost(problem, design.solution, full.final - design.target.state)
    return LoopRuns(plan, full, to_come, tuple(reduced), law.bound(problem.layout.n_s), touching)


def _touching(design: Design, full: LoopTrajectory, run: Callable[..., LoopTrajectory]) -> TouchingLoop:
    """The optimal gain where the tissue meets the obstacles, beside the run without them. Collective.

    Raises SceneError: an obstacle is in the tissue at the start.
    """
    try:
        met = run(design.gain, design.target, len(full.inputs), design.actuation, design.start)
    except SolverError as error:  # the hand itself meets an obstacle, or the loop diverges
        return TouchingLoop(None, reason=str(error))
    distance = float(farthest(met.outputs[-1:], design.target.y, design.problem.columns)[0])
    return TouchingLoop(met, distance, float(met.cost[-1] / full.cost[-1] - 1))


def pole_sets(study: ControlStudy) -> dict[str, np.ndarray]:
    """Poles with the optimal and the a-priori gain and without any, on the lowest modes. Collective."""
    design, loop, basis = study.design, study.design.gain_check.loop, a_priori(study.bases)
    K = design.gain.block
    sets = {
        "without feedback": loop.poles(K.times(np.zeros((K.columns, K.columns)))),
        ("modal gain" if design.modal else "optimal gain"): loop.poles(K),
    }
    best = None if basis is None else basis.best(fast_order(design.problem.layout.n_s))
    if best is not None and best.gain is not None:
        sets[f"a-priori gain, N = {best.N}"] = loop.poles(best.gain.block)
    return {name: p[np.argsort(np.abs(p))][: 2 * SHOWN_MODES] for name, p in sets.items()}


def timed_gains(design: Design, orders: Sequence[int], notify: Notify) -> tuple[BasisGains, ...]:
    """All bases over their orders, see :func:`softgrasp.lqr.design.orders.reduce_gains`, with times. Collective."""
    bases = reduce_gains(design, orders, notify)
    return tuple(replace(b, reports=tuple(with_time(design.problem, r) for r in b.reports)) for b in bases)


def with_time(problem: RiccatiProblem, report: GainReport) -> GainReport:
    """With the seconds of one solution of its reduced equation. Collective."""
    matrices = report.matrices
    if matrices is None:
        return report
    times = partial(timeit.repeat, partial(solve_reduced, matrices), number=1, repeat=SOLUTIONS)
    return replace(report, time_are=min(on_root(problem.layout.comm, times)))


def retune(
    design: Design, bases: Sequence[BasisGains], plan: LoopPlan, notify: Notify
) -> tuple[tuple[Retuned, ...], str]:
    """The a-priori basis and the paper's best at a small order, re-tuned over the box; or why not. Collective.

    The duality gaps of all gains of one setting come from the same few runs of ``plan``.
    """
    layout = design.problem.layout
    reason = outside(design.model)
    offered = [(k, range(fast_order(layout.n_s) + 1)) for k in range(len(bases))]
    chosen = [] if reason else re_tunable(certified(design, bases, offered), layout.n_s)
    if not reason and layout.states > BOX_STATES:
        reason = (
            f"{layout.states} states are more than {BOX_STATES}: the full solutions to compare with would take long"
        )
    if not reason and not chosen:
        reason = f"no basis has a stable gain of order N <= {fast_order(layout.n_s)}"
    if reason:
        return (), reason
    tuners = [Retuner(design.problem, family.at(N)) for family, N in chosen]
    columns: list[list[RetunedGain]] = []
    settings = [materials_at(design.model, *place) for place in grid_of(design.model)]
    for done, materials in enumerate(settings, 1):
        problem = replace(design.problem, system=design.problem.system.with_materials(materials))
        gain_check = cache(partial(_gain_check, problem, design))
        points = [_at(tuner, materials, gain_check) for tuner in tuners]
        if any(point.gain is not None for point in points):
            points = with_bounds(problem, gain_check().solution, points, course_of(design, plan))
        columns.append([replace(point, gain=None) for point in points])
        notify(done, len(settings))
    rows = zip(*columns, strict=True)
    return tuple(Retuned(family.name, N, tuple(row)) for (family, N), row in zip(chosen, rows, strict=True)), ""


def _gain_check(problem: RiccatiProblem, design: Design) -> GainCheck:
    """With the full solution at other materials. Collective."""
    return GainCheck(problem, solve(problem), design.error, law=design.gain_check.law)


def _at(tuner: Retuner, materials: Materials, gain_check: Callable[[], GainCheck]) -> RetunedGain:
    """The gain at one setting and the seconds of its re-tuning. Collective."""
    try:
        point = retuned_gain(tuner, materials, gain_check)
    except (ControlError, SolverError) as failed:  # the full solution, not the re-tuned one
        return RetunedGain(materials, reason=f"no reference: {failed}")
    if point.reason:
        return point
    # the first solution of a size pays for memory and caches, which a running controller does not
    times = partial(timeit.repeat, partial(tuner.solve, materials), number=1, repeat=REPEATS)
    return replace(point, seconds=min(on_root(tuner.problem.layout.comm, times)))


def re_tunable(bases: Sequence[BasisGains], n_s: int) -> list[tuple[BasisFamily, int]]:
    """The a-priori basis and the best of the others, each at its best small order."""
    best = [(b.family, r) for b in bases if b.family is not None and (r := b.best(fast_order(n_s))) is not None]
    best.sort(key=lambda x: (x[1].cost_excess, x[0].name))
    own, others = ([x for x in best if (x[0].name == A_PRIORI) == same] for same in (True, False))
    return [(family, r.N) for family, r in (*own, *others[:1])]
