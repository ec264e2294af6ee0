"""``softgrasp control``: optimal feedback of a scene, its reduced gains, and the loop that they close."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from rich.console import Console
from rich.progress import Progress, TaskProgressColumn

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.scene.control import Loop
from softgrasp.lqr.design.duration import bases_with_bounds, plan
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.orders import BasisGains, orders
from softgrasp.lqr.design.scene import linearised, with_control
from softgrasp.study.control.gain import run_gain, small_controller
from softgrasp.study.control.loop import pole_sets, run_finite, run_loops, save_controllers
from softgrasp.study.control.page import sections
from softgrasp.study.control.result import ControlStudy, Note, Retuned, a_priori, control_result
from softgrasp.study.control.sweep import retune, sweep
from softgrasp.study.control.tables import best_table, summary, summary_rows, tables
from softgrasp.study.pictures.beside import beside
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.report.tables import pairs
from softgrasp.study.shell.session import Flags, Page, Session, list_files

GOAL = 1e-10  # of the solver when the scene names none: the right end of its progress bar
RESTART_STATES = 10_000  # below, the Riccati equation takes seconds and writes no restart files


def run_control(
    path: Path, out: Path, overrides: list[str], console: Console, *, gain_only: bool = False, **flags: Unpack[Flags]
) -> dict[str, Any]:
    """Design the optimal feedback of a scene file, reduce it, close the loop and write the results. Collective.

    Nothing is written before the Riccati equation is solved, but restart files of a large plant: the next call with
    the same scene, folder and rank count goes on from them; they are removed at the end. ``gain_only`` writes the
    controllers, without closed loop and pictures.
    """
    session = Session("control", path, overrides, out, console, **flags)
    model, sentence = with_control(session.model(session.scene(), steps=False))
    if sentence:
        console.print(sentence, soft_wrap=True, markup=False)
    watch, restart = Stopwatch(session.comm), restart_folder(model, out)
    with session.progress(TaskProgressColumn()) as bar:
        if restart is not None:
            exists = session.comm.bcast(restart.exists())
            word = "going on from" if exists else "interrupted, the same command goes on from"
            console.print(f"{word} {restart}", soft_wrap=True, markup=False)
        notes = [Note("table", sentence)] if sentence else []
        if gain_only:
            return run_gain(session, model, watch, solver_bar(bar, model), notes, restart)
        study, fields, others = control_model(session, model, watch, bar, notes, restart)
    with watch.stage("controllers"):
        out.mkdir(parents=True, exist_ok=True)
        target = study.design.target if study.finite is None else study.finite.target
        saved = save_controllers(study.design, study.controller, out, target.state)
    seconds = {**model.watch.seconds, **watch.seconds}
    result = control_result(study, seconds)

    def page() -> Page:
        drawn: list[Path] = []
        if session.pictures and study.retuned:
            from softgrasp.study.control.plots import figure_retune  # brings Matplotlib

            drawn += figure_retune(study.retuned, out / "retune.png")
        drawn += others()
        title = f"{model.scene.name}: optimal feedback"
        parts, files = sections(study, seconds, drawn), [*drawn, *fields, *saved]
        return Page(title, summary(study), parts, tables(study), files)

    if session.comm.rank == 0:
        show(console, study, seconds)
    list_files(console, session.write(model.scene, result, page))
    if session.comm.rank == 0 and restart is not None:
        shutil.rmtree(restart, ignore_errors=True)
    session.comm.Barrier()
    return result


def restart_folder(model: Model, out: Path) -> Path | None:
    """Where the solver keeps restart files: one folder a scene and rank count; None for small plants."""
    layout = model.system.layout
    if layout.states < RESTART_STATES:
        return None
    return out / f"restart-{scene_hash(model.scene)[:12]}-{layout.comm.size}"


def control_model(
    session: Session, model: Model, watch: Stopwatch, bar: Progress, notes: list[Note], restart: Path | None = None
) -> tuple[ControlStudy, list[Path], Callable[[], list[Path]]]:
    """Solve, reduce, close the loop of a scene with a control table, and re-tune while that is drawn. Collective.

    ``watch`` takes the seconds of the stages; more is added to ``notes``; ``restart`` is the folder of restart files.
    Returned are also the field files, and what waits for the pictures on rank 0.
    """
    own_end = not notes  # a scene made for control says how long its loop runs
    finite_strain = model.system.points is not None
    linear = linearised(model)
    feedback = design(linear, watch, solver_bar(bar, model), restart)
    bases: tuple[BasisGains, ...] = ()
    notes, duration = list(notes), plan(feedback, own_end)
    if feedback.modal:
        sentence = "control.method = 'modal': there is no P of the whole plant to compare reduced equations with"
        notes.append(Note("modal", sentence))
    else:
        sizes, few = orders(feedback)
        with watch.stage("reduced"):
            bases = sweep(feedback, sizes, counted(bar, "reduced equations"))
        with watch.stage("bounds"):
            bases = bases_with_bounds(feedback, bases, duration, counted(bar, "duality gaps"))
        notes += [Note("orders", few)] if few else []
    controller, tick, refused = small_controller(feedback, a_priori(bases))
    notes += refused
    sampled = feedback.quality.sampled
    if sampled is not None and sampled.reason:
        notes.append(Note("sampling", f"the loop from tick to tick is not certified: {sampled.reason}"))
    notes += unused_rate(model)
    notes += [Note("end", duration.note)] if duration.note else []
    frames = Frames(model, session.out, session.pictures)
    with watch.stage("loop"):
        loops = run_loops(feedback, bases, duration, frames, counted(bar, "closed loop"))
    finite = None
    if finite_strain:
        with watch.stage("finite strain"):
            finite = run_finite(feedback, model, loops.full, duration, counted(bar, "loop of finite strain"))
    study = ControlStudy(feedback, bases, (), controller, tick, loops, tuple(notes), finite)
    fields, drawn = frames.close(), _drawn(session, study, frames)
    if feedback.modal:
        return study, fields, drawn
    retuned: tuple[Retuned, ...] = ()
    with watch.stage("retune"):
        if finite_strain and model.system.gravity is not None:
            why = "the stiffness is that of the equilibrium, which moves with the material"
        else:
            retuned, why = retune(feedback, bases, duration, counted(bar, "re-tuning"))
    notes += [Note("retune", f"no re-tuning: {why}")] if why else []
    return replace(study, retuned=retuned, notes=tuple(notes)), fields, drawn


def _drawn(session: Session, study: ControlStudy, frames: Frames) -> Callable[[], list[Path]]:
    """Begin to draw on rank 0. Collective."""
    if not session.pictures:
        return list
    poles = pole_sets(study)

    def draw(out: Path) -> list[Path]:
        from softgrasp.study.control.plots import draw_all  # brings Matplotlib

        return draw_all(out, study, poles, frames)

    return beside(session.comm, session.out, draw)


def unused_rate(model: Model) -> list[Note]:
    """Says that a rate other than the default does nothing, where the loop is not sampled."""
    loop = Loop() if model.scene.control is None else model.scene.control.loop
    if loop.sampling == "held" or loop.rate == Loop().rate:
        return []
    text = f"control.loop.rate = {loop.rate:g} Hz has no effect: set control.loop.sampling = 'held' to sample the loop"
    return [Note("sampling", text)]


def solver_bar(bar: Progress, model: Model) -> Callable[[dict[str, float]], None]:
    """Progress of an iteration: how far its residual has fallen on the way to the tolerance."""
    control = model.scene.control
    goal = -np.log10(GOAL if control is None else control.tolerance)
    task = bar.add_task("Riccati equation", total=float(goal))
    least = [1.0]

    def note(entry: dict[str, float]) -> None:
        value = entry.get("residual", entry.get("change", 1.0))
        if np.isfinite(value) and value > 0:
            least[0] = min(least[0], value)
            bar.update(task, completed=min(float(goal), -float(np.log10(least[0]))))

    return note


def counted(bar: Progress, text: str) -> Callable[[int, int], None]:
    """A bar that is told what is done and how much there is."""
    task = bar.add_task(text, total=None)

    def note(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)

    return note


def show(console: Console, study: ControlStudy, seconds: dict[str, float]) -> None:
    """Summary, then the reduced gains."""
    for sentence in (*study.findings, *(note.text for note in study.notes if note.topic != "table")):
        console.print(f"note: {sentence}", soft_wrap=True, markup=False)
    console.print(pairs(summary_rows(study, seconds)))
    if study.bases:
        console.print(best_table(study.bases).terminal(wrap=[0], width=console.width))
