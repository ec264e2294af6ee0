"""``softgrasp control``: optimal feedback of a scene, its reduced gains, and the loop that they close."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskProgressColumn
from rich.table import Table

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.scene.control import Control, ControlOutput
from softgrasp.study.control.loop import make_controller, plan, run_loops, save_controllers
from softgrasp.study.control.page import Found, control_result, summary_rows, write_all
from softgrasp.study.control.solve import design
from softgrasp.study.control.sweep import Retuned, SweptBasis, orders, retune, sweep
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.shell.session import list_files, open_model, open_scene, progress_bar

GOAL = 1e-10  # of the solver when the scene names none: the right end of its progress bar
RESTART_STATES = 10_000  # below, the Riccati equation takes seconds and writes no restart files


def run_control(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    quiet: bool = False,
    pictures: bool = True,
) -> dict[str, Any]:
    """Design the optimal feedback of a scene file, reduce it, close the loop and write the results. Collective.

    Nothing is written before the Riccati equation is solved, but restart files of a large plant: the next call with
    the same scene, folder and rank count goes on from them; they are removed at the end.

    Args:
        path: scene file.
        out: folder of the results.
        overrides: key=value changes of the scene.
        console: where the tables go.
        quiet: no progress bars.
        pictures: draw figures and the animation.

    Returns:
        What result.json holds.

    Raises:
        SoftgraspError: with one sentence.
    """
    begin = time.perf_counter()
    comm = MPI.COMM_WORLD
    model, note = with_control(open_model(open_scene(path, overrides, console), console))
    if note:
        console.print(note, soft_wrap=True, markup=False)
    watch = Stopwatch(comm)
    with progress_bar(console, TaskProgressColumn(), quiet=quiet) as bar:
        restart = restart_folder(model, out)
        if restart is not None:
            word = "going on from" if comm.bcast(restart.exists()) else "interrupted, the same command goes on from"
            console.print(f"{word} {restart}", soft_wrap=True, markup=False)
        found, frames = control_model(model, out, watch, bar, [note] if note else [], pictures, restart)
    files = frames.close()
    with watch.stage("controllers"):
        out.mkdir(parents=True, exist_ok=True)
        files += save_controllers(model, found.design, found.made, out)
    poles = None
    if pictures:
        from softgrasp.study.control.plots import pole_sets  # brings Matplotlib

        poles = pole_sets(found.design, found.swept)
    result = control_result(model, found, watch)
    if comm.rank == 0:
        drawing = time.perf_counter()
        drawn: list[Path] = []
        if poles is not None:
            from softgrasp.study.control.plots import draw_all

            drawn = draw_all(out, found.design, found.swept, found.retuned, poles, found.runs, frames)
        now = time.perf_counter()
        result["time"] |= {"pictures": now - drawing, "total": now - begin}
        files = [*write_all(out, path, overrides, model, found, result, drawn), *files]
        show(console, found, result)
        list_files(console, files)
        if restart is not None:
            shutil.rmtree(restart, ignore_errors=True)
    comm.Barrier()
    return result


def restart_folder(model: Model, out: Path) -> Path | None:
    """Where the solver keeps restart files: one folder a scene and rank count; None for small plants."""
    layout = model.system.layout
    if layout.states < RESTART_STATES:
        return None
    return out / f"restart-{scene_hash(model.scene)[:12]}-{layout.comm.size}"


def with_control(model: Model) -> tuple[Model, str]:
    """A scene without a [control] table gets tip output and Q = R = 1, and a turning hand is seen too. Collective.

    Returns:
        The model, and the sentence that says so; empty when the scene has its own table.
    """
    if model.scene.control is not None:
        return model, ""
    tip = make_outputs(model.scene, model.system)[0]
    outputs = [ControlOutput(kind="node", point=list(tip.point), name=tip.name)]
    what = f"the node at ({', '.join(f'{x:.4g}' for x in tip.point)}), the farthest from the hand,"
    if model.system.layout.n_s > model.system.layout.dimension:  # one node does not see all rotations
        outputs.append(ControlOutput(kind="hand", point=None, name="hand"))
        what += " and the hand itself"
    control = Control(outputs=outputs)
    note = f"the scene has no [control] table: {what} as output, Q = R = 1"
    return replace(model, scene=model.scene.model_copy(update={"control": control})), note


def control_model(
    model: Model,
    out: Path,
    watch: Stopwatch,
    bar: Progress,
    notes: list[str],
    pictures: bool,
    restart: Path | None = None,
) -> tuple[Found, Frames]:
    """Solve, reduce, re-tune and close the loop. Collective.

    Args:
        model: the scene, with a control table.
        out: where field files go.
        watch: takes the seconds of the stages.
        bar: shows what is done.
        notes: what is to be said in the report; more is added to the result.
        pictures: keep frames.
        restart: folder for the solver's restart files.

    Raises:
        SoftgraspError: with one sentence.
    """
    own_end = not notes  # a scene made for control says how long its loop runs
    solved = design(model, watch, solver_bar(bar, model), restart)
    swept: tuple[SweptBasis, ...] = ()
    retuned: tuple[Retuned, ...] = ()
    notes = list(notes)
    if solved.modal:
        notes.append("control.method = 'modal': no P of the whole plant to compare reduced equations with")
    else:
        wanted, few = orders(model, solved)
        with watch.stage("reduced"):
            swept = sweep(solved, wanted, counted(bar, "reduced equations"))
        with watch.stage("retune"):
            retuned, why = retune(model, solved, swept, counted(bar, "re-tuning"))
        notes += [text for text in (few, why and f"no re-tuning: {why}") if text]
    made, why = make_controller(model, solved, swept)
    notes += [f"no small controller: {why}"] if why else []
    sampled = solved.quality.sampled
    if sampled is not None and sampled.reason:
        notes.append(f"the loop from tick to tick is not certified: {sampled.reason}")
    timing = plan(model, solved, own_end)
    notes += [timing.note] if timing.note else []
    frames = Frames(model, out, pictures)
    with watch.stage("loop"):
        runs = run_loops(model, solved, swept, made, timing, frames, counted(bar, "closed loop"))
    return Found(solved, swept, retuned, made, runs, tuple(notes)), frames


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


def show(console: Console, found: Found, result: dict[str, Any]) -> None:
    """Summary, then the reduced gains."""
    for sentence in (*result["findings"], *(n for n in found.notes if "[control]" not in n)):
        console.print(f"note: {sentence}", soft_wrap=True, markup=False)
    table = Table(box=None, show_header=False, pad_edge=False)
    for row in summary_rows(result):
        table.add_row(*map(escape, row))  # no brackets lost
    console.print(table)
    if not found.swept:
        return
    best = Table("best stable gain", "N", "error of P", "error of K", "excess cost", "abscissa [1/s]", "ARE, ms",
                 "not stable at N", box=None, pad_edge=False)  # fmt: skip
    for s in found.swept:
        r = s.best()
        bad = ", ".join(str(x.N) for x in s.reports if not x.stable)
        if r is None:
            best.add_row(s.title, *([""] * 6), bad or escape(s.refused))
            continue
        values = (f"{r.error_P:.1e}", f"{r.error_K:.1e}", f"{r.cost_excess:.1e}", f"{r.abscissa_full:.4g}")
        best.add_row(s.title, str(r.N), *values, f"{1e3 * r.time_are:.2g}", bad)
    console.print(best)
