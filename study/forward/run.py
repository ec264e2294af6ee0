"""``softgrasp simulate``: run, show, write."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from softgrasp.fem import (
    EFFECTS,
    FRAMES,
    Model,
    check_ranks,
    counted,
    forecasts,
    frame_count,
    run_seconds,
    sharing_factors,
    told,
)
from softgrasp.fem.accuracy.price import SHARE
from softgrasp.fem.errors import Interrupted, Paused, ResourceError, SceneError, SolverError
from softgrasp.fem.run.forecast import Forecast
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.states.frames import LIGHT
from softgrasp.study.forward.accuracy import accuracy_report, check_estimated, estimate_error
from softgrasp.study.forward.cautions import looked_at, run_warnings, small_obstacles
from softgrasp.study.forward.result import Simulation, simulate_result
from softgrasp.study.pictures import Frames, speed_up
from softgrasp.study.report import Page, Section, captioned, in_words, of_scene
from softgrasp.study.shell import Flags, Session, folder_lock, list_files

SLOW_START = 5.0  # time of the equilibrium from which it is announced [s]
CAPTIONS = {
    "move.png": "The body at some instants of the move.",
    "move.gif": "",
    "mesh_error.png": "Outputs relative to the hand on this mesh and corrected, with the band of the error bound.",
    "contact.png": "Force of each obstacle (its magnitude), its least gap, and how many nodes it presses. Bold: mean "
    "force of two steps; thin: of each step.",
    "traces.png": "Hand and outputs against time; below, the outputs relative to the hand.",
}


@folder_lock()
def run_simulate(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    resume: bool = False,
    until: int | None = None,
    certify: bool = False,
    **flags: Unpack[Flags],
) -> dict[str, Any]:
    """Simulate a scene file and write its results; nothing comes back of a run that ``until`` stops. Collective."""
    if resume and flags.get("empty"):
        raise SceneError("--empty removes what --resume goes on from; give one of them")
    session = Session("simulate", path, overrides, out, console, **flags)
    scene = session.scene()
    if certify:
        check_estimated(scene)
    if resume:
        check_ranks(session.comm, out / "checkpoint")
    model = session.model(scene)
    model.system.release()
    with sharing_factors(model.system, large=False):  # that of an equilibrium serves the estimate
        return _run(session, model, resume=resume, until=until, certify=certify)


def _run(session: Session, model: Model, *, resume: bool, until: int | None, certify: bool) -> dict[str, Any]:
    scene, out, console, n_e = model.scene, session.out, session.console, model.system.layout.n_e
    frames = Frames(model, out, session.pictures)
    for text in _announced(model):
        console.print(text, soft_wrap=True)

    def join(run: Run) -> None:
        frames.begin(run)
        if resume:
            console.print(f"resumed from step {run.begun} of {run.steps}{_lost(frames, run)}", soft_wrap=True)

    with session.progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("steps", total=scene.time.steps)

        def progress(run: Run) -> None:
            newton = run.midpoint.figures()
            kind = "steps" if newton is None else f"steps ({newton.mean:.2g} iterations each)"
            bar.update(task, completed=run.reached, description=kind)

        settle = _equilibrium_bar(bar)
        options = RunOptions(out, resume, until, progress, frames, join, frames.keep, settle, looked_at(n_e))
        try:
            run = simulate(model, options)
        except (Interrupted, ResourceError) as stopped:
            _say_stopped(console, frames, stopped)
            return {}
    fields = frames.close()
    result = simulate_result(model, run, run_warnings(model, run, frames.most[1:]))
    tables = {"trajectory.csv": result.trajectory()}
    session.keep(scene, result.to_json(), tables)
    mesh_error, unknown = None, "The error of the mesh is not known: its estimate does not include contact."
    if run.contact is None:
        mesh_error, unknown = estimate_error(model, None if certify else SHARE * run_seconds(model))
    accuracy = accuracy_report(mesh_error, run)
    result = replace(result, warnings=(*result.warnings, *accuracy.warnings, *([unknown] if unknown else [])))

    def page() -> Page:
        drawn = frames.draw(out, run)
        if session.pictures and mesh_error is not None and mesh_error.by != "coarser":
            from softgrasp.study.pictures.traces import figure_mesh_error  # brings Matplotlib

            drawn += figure_mesh_error(out / "mesh_error.png", run, mesh_error)
        return Page(
            scene.name, result.summary(), _sections(result, drawn), tables, [*fields, *drawn],
            errors=accuracy.errors, warnings=result.warnings,
        )  # fmt: skip

    numbers = {**result.to_json(), **accuracy.keys}
    session.write(scene, numbers, page)
    if certify and mesh_error is None:
        raise SolverError(unknown)
    return numbers


def _say_stopped(console: Console, frames: Frames, stopped: Interrupted | ResourceError) -> None:
    """List the fields of a run that has stopped, and why; raise the reason unless it was asked for. Collective."""
    if files := frames.close():
        list_files(console, files)
    if not isinstance(stopped, Paused):
        raise stopped
    console.print(str(stopped), soft_wrap=True, markup=False)


def _equilibrium_bar(bar: Progress) -> Callable[[float], None]:
    """A bar of the digits of an iterated equilibrium, shown while it is solved."""
    task = bar.add_task("equilibrium, percent of its digits", total=100, visible=False)
    return lambda share: bar.update(task, completed=round(100 * share), visible=share < 1)


def _announced(model: Model) -> Iterator[str]:
    """What a run reports before it starts. Collective."""
    modelled = forecasts(model)
    start = _slow_start(modelled, model.system.layout.comm.size)
    yield from filter(None, (told(modelled), start, _few_fields(model), *small_obstacles(model)))


def _slow_start(modelled: Sequence[Forecast], ranks: int) -> str:
    """How long the equilibrium takes before the first step, where that is a while."""
    seconds = next((f.equilibrium for f in modelled if f.ranks == ranks), 0.0)
    return f"about {seconds:.2g} s of that are the equilibrium, before the first step" if seconds >= SLOW_START else ""


def _few_fields(model: Model) -> str:
    """That a large body has its fields written at few instants, unless the scene says at how many."""
    scene, n_e = model.scene, model.system.layout.n_e
    count = frame_count(scene, n_e)
    if count >= FRAMES or scene.output.frames != "auto" or scene.output.fields == "none":
        return ""
    return f"fields at {count + 1} instants, for n_e is above {LIGHT}; --set output.frames={FRAMES} writes more"


def _lost(frames: Frames, run: Run) -> str:
    """What the pictures and fields of a resumed run lack, in words; rank 0 only."""
    text, lost = "", frames.lacking(run.begun)
    if lost:
        text = f"; {counted(lost, 'earlier frame')} {'is' if lost == 1 else 'are'} not kept, the pictures do without"
    if frames.foreign:
        text += "; the fields before are left out: another run has written in their place"
    return text


def _sections(result: Simulation, drawn: list[Path]) -> list[Section]:
    scene = result.scene
    faster = speed_up(np.array([0.0, scene.time_end]))
    move = "The move in real time." if faster == 1 else f"The move at {faster:g} times its speed."
    effects = [(name, effect.term, effect.cost) for name, effect in EFFECTS.items() if effect.active(scene)]
    off = [name for name, effect in EFFECTS.items() if not effect.active(scene)]
    return [
        Section("", figures=captioned(drawn, CAPTIONS | {"move.gif": move})),
        Section("Result", rows=result.rows(), terminal=True),
        of_scene(scene),
        Section("Effects", f"Off: {in_words(off)}.", header=("effect", "adds", "cost"), rows=effects),
    ]
