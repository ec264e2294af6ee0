"""``softgrasp control``: optimal feedback of a scene, its reduced gains, and the loop that they close."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

import numpy as np
from rich.console import Console
from rich.progress import Progress, TaskProgressColumn

from softgrasp.fem import Loop, Model, Scene, SceneError, Stopwatch, remove_own, scene_hash, sharing_factors
from softgrasp.lqr import A_PRIORI, Design, PlantState, control_of, finite_problem, linearised, with_control
from softgrasp.lqr.design.duration import plan
from softgrasp.lqr.design.feedback import design, judge
from softgrasp.lqr.design.orders import BasisGains, bases_with_bounds, orders, reduce_gains
from softgrasp.study.control import measure, report
from softgrasp.study.control.result import ControlStudy, GainStudy, Retuned
from softgrasp.study.pictures import Frames, draw_in_background
from softgrasp.study.report import Page
from softgrasp.study.shell import Flags, Session, folder_lock

if TYPE_CHECKING:  # observers are not imported where a scene has none
    from softgrasp.study.control.observer.result import ObservedStudy
    from softgrasp.study.control.obstacle.result import PlannedStudy

WITHOUT_CONTACT = (
    "Gains, bounds and margins are those of the plant without obstacles: no certificate covers contact, and "
    "feedback that works without obstacles may fail at one."
)
RESTART_STATES = 10_000  # below, the Riccati equation takes seconds and writes no restart files


@folder_lock()
def run_control(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    gain_only: bool = False,
    retune: bool = False,
    **flags: Unpack[Flags],
) -> dict[str, Any]:
    """Design the optimal feedback of a scene file, reduce it, close the loop and write the results. Collective.

    Nothing is written before the Riccati equation is solved, but restart files of a large plant: the next call with
    the same scene, folder and rank count goes on from them; they are removed at the end. ``gain_only`` writes the
    controllers, without closed loop and pictures; ``retune`` solves the full equation at the corners, edges and the
    middle of the box of lambda and mu, to compare re-tuned gains with. Returns the content of result.json.
    """
    session = Session("control", path, overrides, out, console, **flags)
    scene = session.scene()
    refuse_touching(scene)
    scene.refuse_frame("control")
    model, sentence = with_control(session.model(scene, steps=False))
    if sentence:
        console.print(sentence, soft_wrap=True, markup=False)
    watch, layout = Stopwatch(session.comm), model.system.layout
    folder = out / f"restart-{scene_hash(model.scene)[:12]}-{layout.comm.size}"  # of one scene and rank count
    restart = folder if layout.states >= RESTART_STATES else None
    fields: list[Path] = []
    drawn: Callable[[], list[Path]] = list
    with session.progress(TaskProgressColumn()) as bar:
        if restart is not None:
            exists = session.comm.bcast(restart.exists())
            word = "going on from" if exists else "interrupted, the same command goes on from"
            console.print(f"{word} {restart}", soft_wrap=True, markup=False)
        plant = linearised(model)
        if not retune:
            model.system.release()
        observed, study = None, cast(GainStudy | None, None)
        _require(plant)
        with sharing_factors(plant.system):
            feedback = design(plant, watch, solver_bar(bar, model), restart, judged=not gain_only)
            if control_of(model).observer is not None:
                from softgrasp.study.control.observer.measure import observed_study

                observed = observed_study(feedback, watch)
            if gain_only:
                study = replace(small_study(feedback, watch, sentence), observed=observed)
            else:
                planned = planned_of(model, feedback, watch, bar, observed)
                gains = reduced_gains(feedback, watch, bar)
        if study is None:
            study, fields, drawn = loop_study(session, model, feedback, watch, bar, sentence, observed, planned, gains)
            if retune:
                study = with_retuning(model, study, watch, bar)
    with watch.stage("controllers"):
        out.mkdir(parents=True, exist_ok=True)
        saved = measure.save_controllers(study, out, end_state(model, study))
    seconds = {**model.watch.seconds, **watch.seconds}
    result = study.result(seconds)

    def page() -> Page:
        pictures: list[Path] = []
        if session.pictures and isinstance(study, ControlStudy) and study.retuned:
            from softgrasp.study.control.plots import figure_retune  # brings Matplotlib

            pictures += figure_retune(study.retuned, out / "retune.png")
        pictures += drawn()
        return report.compose(study, seconds, pictures, [*fields, *saved])

    session.write(model.scene, result, page)
    if session.comm.rank == 0 and restart is not None:
        remove_own(out, restart)
    session.comm.Barrier()
    return result


def _require(plant: Model) -> None:
    """Refuse observers and plans that cannot be made, before the Riccati equation is solved. Collective."""
    if control_of(plant).observer is not None:
        from softgrasp.lqr.design.observer import require_observable  # no other scene needs it

        require_observable(plant)
    if control_of(plant).constraints is not None:
        from softgrasp.lqr.design.constrained import require_plan  # no other scene needs it

        require_plan(plant)


def refuse_touching(scene: Scene) -> None:
    """Refuse contact beside what cannot go with it. Raises SceneError."""
    if not scene.effects.obstacles:
        return
    other = "effects.finite_strain" if scene.effects.finite_strain is not None else ""
    if scene.control is not None and scene.control.constraints is not None:
        other = "control.constraints"  # which keeps the body clear of obstacles
    if other:
        raise SceneError(
            f"scene '{scene.name}': control cannot go with effects.obstacles and {other} yet; set one of them to false"
        )


def small_study(feedback: Design, watch: Stopwatch, note: str) -> GainStudy:
    """The a-priori gains and the small controller, without closed loop. Collective."""
    bases: tuple[BasisGains, ...] = ()
    if not feedback.modal:
        with watch.stage("reduced"):
            bases = reduce_gains(feedback, orders(feedback)[0], names=(A_PRIORI,), offered_only=True)
    with watch.stage("judge"):
        judge(feedback)  # its certificate was made beside that of a reduced gain
    return measure.gain_study(feedback, bases, note, WITHOUT_CONTACT if feedback.model.scene.effects.obstacles else "")


def end_state(model: Model, study: GainStudy) -> PlantState:
    """Where the controllers go, at finite strain the equilibrium there. Collective."""
    if isinstance(study, ControlStudy) and study.finite is not None:
        return study.finite.target.state
    if model.system.points is None:
        return study.design.target.state
    return finite_problem(study.design.problem, model.system, study.design.target)[1].state


def planned_of(
    model: Model, feedback: Design, watch: Stopwatch, bar: Progress, observed: ObservedStudy | None
) -> PlannedStudy | None:
    """The plan past obstacles, before all else, since what has no plan is refused; None without one. Collective."""
    if control_of(model).constraints is None:
        return None
    from softgrasp.study.control.obstacle.measure import planned_study  # no other scene needs it

    found = None if observed is None else observed.observed
    return planned_study(feedback, model, watch, counted(bar, "plan on the full plant"), found)


def reduced_gains(feedback: Design, watch: Stopwatch, bar: Progress) -> tuple[tuple[BasisGains, ...], str]:
    """All reduced gains without their bounds, and why there are few or none. Collective."""
    if feedback.modal:
        return (), "control.method = 'modal': there is no P of the whole plant to compare reduced equations with"
    sizes, reason = orders(feedback)
    with watch.stage("reduced"):
        return measure.timed_gains(feedback, sizes, counted(bar, "reduced equations")), reason


def loop_study(
    session: Session,
    model: Model,
    feedback: Design,
    watch: Stopwatch,
    bar: Progress,
    note: str,
    observed: ObservedStudy | None,
    planned: PlannedStudy | None,
    gains: tuple[tuple[BasisGains, ...], str],
) -> tuple[ControlStudy, list[Path], Callable[[], list[Path]]]:
    """Bounds of all reduced gains and the closed loops. Collective.

    Returned are also the field files, and what waits for the pictures on rank 0.
    """
    duration = plan(feedback, own_end=not note)  # a scene made for control says how long its loop runs
    finite_strain, sampled, touches = (
        model.system.points is not None,
        feedback.quality.sampled,
        model.scene.effects.obstacles,
    )
    (bases, reason), frames = gains, Frames(model, session.out, session.pictures)
    with measure.loop_of(feedback, duration, model if touches else None) as loop:
        if not feedback.modal:
            with watch.stage("bounds"):
                bases = bases_with_bounds(feedback, bases, duration, counted(bar, "duality gaps"), loop)
        with watch.stage("loop"):
            loops = measure.run_loops(loop, feedback, bases, duration, frames, counted(bar, "closed loop"))
    small = measure.gain_study(feedback, bases, note, reason)
    lost = f"the loop from tick to tick is not certified: {sampled.reason}" if sampled and sampled.reason else ""
    free = WITHOUT_CONTACT if touches else ""
    notes = (*small.notes, *filter(None, (lost, unused_rate(model), duration.note, free)))
    finite = None
    if finite_strain:
        with watch.stage("finite strain"):
            finite = measure.run_finite(feedback, model, loops.full, duration, counted(bar, "loop of finite strain"))
    study = ControlStudy(
        feedback, bases, small.controller, small.tick, notes, loops, finite, planned=planned, observed=observed
    )
    return study, frames.close(), _drawn(session, study, frames)


def with_retuning(model: Model, study: ControlStudy, watch: Stopwatch, bar: Progress) -> ControlStudy:
    """With gains re-tuned over the box of lambda and mu while the rest is drawn, or a note why not. Collective."""
    retuned: tuple[Retuned, ...] = ()
    with watch.stage("retune"):
        if study.design.modal:
            why = "control.method = 'modal' has no reduced equations"
        elif study.finite is not None and model.system.gravity is not None:
            why = "the stiffness is that of the equilibrium, which moves with the material"
        else:
            notify = counted(bar, "re-tuning")
            retuned, why = measure.retune(study.design, study.bases, study.loops.plan, notify)
    return replace(study, retuned=retuned, notes=(*study.notes, f"no re-tuning: {why}") if why else study.notes)


def _drawn(session: Session, study: ControlStudy, frames: Frames) -> Callable[[], list[Path]]:
    """Begin to draw on rank 0, in two processes: nothing else is left to compute. Collective."""
    if not session.pictures:
        return list
    poles = measure.pole_sets(study)
    if session.comm.rank != 0:
        return list
    from softgrasp.study.control.plots import draw_loop, draw_move  # brings Matplotlib, once for both processes

    parts = (
        partial(draw_move, study=study, frames=frames),
        partial(draw_loop, study=study, poles=poles, frames=frames),
    )
    begun = [draw_in_background(session.comm, session.out, draw) for draw in parts]
    return lambda: [file for files in begun for file in files()]


def unused_rate(model: Model) -> str:
    """Says that a rate other than the default does nothing, where neither loop nor observer is sampled."""
    control = control_of(model)
    loop = control.loop
    if loop.sampling == "held" or loop.rate == Loop().rate or control.observer is not None:
        return ""
    return f"control.loop.rate = {loop.rate:g} Hz has no effect: set control.loop.sampling = 'held' to sample the loop"


def solver_bar(bar: Progress, model: Model) -> Callable[[dict[str, float]], None]:
    """Progress of an iteration: how far its residual has fallen on the way to the tolerance."""
    goal = -np.log10(control_of(model).tolerance)
    task = bar.add_task("Riccati equation", total=float(goal))
    least = [1.0]

    def note(entry: dict[str, float]) -> None:
        value = entry.get("residual", entry.get("change", 1.0))
        if np.isfinite(value) and value > 0:
            least[0] = min(least[0], value)
            bar.update(task, completed=min(float(goal), -float(np.log10(least[0]))))

    return note


def counted(bar: Progress, text: str) -> Callable[[int, int], None]:
    """A bar of what is done and how much there is."""
    task = bar.add_task(text, total=None)

    def note(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)

    return note
