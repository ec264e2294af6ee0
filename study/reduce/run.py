"""``softgrasp reduce``: reduced models of a scene, their errors and their times beside the full model's."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.archive import save_model
from softgrasp.reduction.replay import Reference, reference
from softgrasp.study.forward.result import simulate_result
from softgrasp.study.reduce.box import Box, box_of, box_result, measure_box
from softgrasp.study.reduce.findings import findings
from softgrasp.study.reduce.page import draw_all, write_all
from softgrasp.study.reduce.sweep import Swept, best, chosen_methods, sweep
from softgrasp.study.reduce.tables import (
    BOX_HEADER,
    ERROR_HEADER,
    N_NOTE,
    TIME_HEADER,
    FullTimes,
    Speed,
    box_note,
    box_rows,
    error_note,
    error_rows,
    inner_note,
    refused_rows,
    speed_dicts,
    speed_notes,
    speed_of,
    time_rows,
)
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.session import list_files, open_model, open_scene, progress_bar

FULL_REPEATS = 3  # behind the median of the full run
PATIENCE = 2.0  # seconds of a full run above which one is enough


@dataclass(frozen=True)
class Reduced:
    """All that ``softgrasp reduce`` found.

    Attributes:
        against: the full run.
        swept: every method.
        times: of the full model.
        speeds: every method with a model against the full model.
        box: errors at other parameters.
    """

    against: Reference
    swept: tuple[Swept, ...]
    times: FullTimes
    speeds: tuple[Speed, ...]
    box: Box


def check_scene(scene: Scene) -> tuple[str, ...]:
    """Methods of the scene. Not collective.

    Raises:
        SceneError: the scene keeps no snapshots that a basis could be built from.
        BasisError: a method is unknown.
    """
    if scene.output.snapshots != "memory":
        raise SceneError(
            f"output.snapshots is '{scene.output.snapshots}'; it must be 'memory' for a reduction, which builds its "
            "bases from the states in memory"
        )
    if scene.effects.reaction and scene.output.every != 1:
        raise SceneError(
            f"output.every is {scene.output.every}; it must be 1 with effects.reaction, because the force on the hand "
            "needs every state"
        )
    return chosen_methods(scene.reduction)


def full_times(model: Model, first: Trajectory) -> FullTimes:
    """Median seconds of the full run, of several when it is short. Collective."""
    steps, factor = [_whole(first)], [first.seconds["factor"]]
    comm = model.system.layout.comm
    repeats = comm.bcast(FULL_REPEATS if steps[0] < PATIENCE else 1)
    for _ in range(repeats - 1):
        again = simulate(replace(model, watch=Stopwatch(comm)))
        steps.append(_whole(again))
        factor.append(again.seconds["factor"])
    return FullTimes(statistics.median(steps), statistics.median(factor))


def _whole(run: Trajectory) -> float:
    """Seconds of all steps; the first is not among those measured, since it sets up the solver."""
    n = len(run.times) - 1
    return run.seconds["steps"] / max(n - 1, 1) * n


def run_reduce(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    quiet: bool = False,
    pictures: bool = True,
) -> dict[str, Any]:
    """Reduce a scene file by all its methods and write the results. Collective.

    Raises:
        SoftgraspError: with one sentence.
    """
    begin = time.perf_counter()
    comm = MPI.COMM_WORLD
    scene = open_scene(path, overrides, console)
    names = check_scene(scene)
    model = open_model(scene, console)
    watch = Stopwatch(comm)
    with progress_bar(console, MofNCompleteColumn(), quiet=quiet) as bar:
        run, found = reduce_model(model, names, bar, watch)
    with watch.stage("models"):
        files = save_models(out, found.swept)
    views = None
    if pictures:
        from softgrasp.study.reduce.pictures import gather_views  # brings Matplotlib

        views = gather_views(model, found.against, found.swept)
    result = reduce_result(model, run, found, watch)
    if comm.rank == 0:
        drawing = time.perf_counter()
        out.mkdir(parents=True, exist_ok=True)
        drawn = draw_all(out, found, views) if pictures else []
        now = time.perf_counter()
        result["time"] |= {"pictures": now - drawing, "total": now - begin}
        files = [*write_all(out, path, overrides, scene, found, result, drawn), *files]
        show(console, found, result)
        list_files(console, files)
    comm.Barrier()
    return result


def reduce_model(model: Model, names: Sequence[str], bar: Progress, watch: Stopwatch) -> tuple[Trajectory, Reduced]:
    """Full run, every method, errors over the box. Collective.

    Args:
        model: the scene.
        names: methods.
        bar: shows what is done.
        watch: takes the seconds of "full", "sweep" and "box".

    Raises:
        SolverError: a solve failed or a factorisation did.
        ResourceError: the snapshots do not fit.
    """
    scene = model.scene
    task = bar.add_task("full run", total=scene.time.steps)

    def stepped(run: Run) -> None:
        bar.update(task, completed=run.reached)

    with watch.stage("full"):
        run = simulate(model, RunOptions(progress=stepped))
        against = reference(model, run)
        times = full_times(model, run)
    bar.remove_task(task)
    size = len(scene.reduction.N)
    task = bar.add_task("bases", total=size * len(names))
    swept = []
    with watch.stage("sweep"):
        for k, name in enumerate(names):

            def reduced(key: str, done: int, of: int, k: int = k) -> None:
                bar.update(task, completed=size * k + size * done // of, description=key)

            swept.append(sweep(name, against, scene.reduction, reduced))
            bar.update(task, completed=size * (k + 1))
    bar.remove_task(task)
    task = bar.add_task("other parameters", total=None)
    with watch.stage("box"):
        box = measure_box(against, swept, lambda done, of: bar.update(task, completed=done, total=of))
    bar.remove_task(task)
    speeds = tuple(s for s in (speed_of(each, times) for each in swept) if s is not None)
    return run, Reduced(against, tuple(swept), times, speeds, box)


def save_models(out: Path, swept: Sequence[Swept]) -> list[Path]:
    """Write the best stable model of every method into ``out/models``. Collective."""
    files = []
    for s in swept:
        i = best(s.points)
        if i is not None:
            files.append(out / "models" / f"{s.method.key}.h5")
            save_model(s.models[i], files[-1])
    return files


def reduce_result(model: Model, run: Trajectory, found: Reduced, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    whole = simulate_result(model, run).to_json()
    kept = (
        "scene", "scene_hash", "version", "ranks", "machine", "n_s", "n_e", "states", "cells", "steps", "dt", "solver",
    )  # fmt: skip
    scene = model.scene.reduction
    return {
        "command": "reduce",
        **{key: whole[key] for key in kept},
        "reduction": scene.model_dump(mode="json"),
        "N_means": N_NOTE,
        "methods": {s.method.key: s.as_rows() for s in found.swept},
        "about": {
            s.method.key: {
                "title": s.method.title,
                "paper": s.method.paper,
                "structure_preserving": s.method.preserving,
                "inner": s.inner,
                "N_energy": s.kept,
                "N_refused": s.refused,
            }
            for s in found.swept
        },
        "findings": findings(found.swept),
        "speed": speed_dicts(found.speeds),
        "speed_notes": speed_notes(whole["n_e"], whole["steps"], found.times, found.speeds),
        "box": box_result(found.box),
        "time": {
            **{key: whole["time"][key] for key in ("mesh", "assembly", "factor", "steps", "per_step")},
            "full_steps_median": found.times.steps,
            "full_factor_median": found.times.factor,
            **watch.seconds,
        },
        "memory_peak_mb": peak_memory_mb(model.system.layout.comm),
    }


def show(console: Console, found: Reduced, result: dict[str, Any]) -> None:
    """Print the tables."""
    share = f"{100 * result['reduction']['energy']:g} %"
    _print(console, (ERROR_HEADER[0], share, *ERROR_HEADER[2:]), error_rows(found.swept))
    note = f"{error_note(share)} fixed: with fixed solid modes. {N_NOTE} {inner_note(found.swept)}"
    console.print(note, style="dim", markup=False)
    for sentence in result["findings"]:
        console.print(sentence, markup=False)
    for sizes, titles, reason in refused_rows(found.swept):
        console.print(_narrow(f"N = {sizes} refused for {titles}: {reason}."), markup=False)
    _print(console, TIME_HEADER, time_rows(found.speeds))
    for note in result["speed_notes"]:
        console.print(note)
    if found.box.none:
        console.print(f"no errors at other parameters: {found.box.none}")
    else:
        console.print(box_note(found.box, *box_of(found.against.model)), markup=False)
        _print(console, BOX_HEADER, box_rows(found.box))


def _print(console: Console, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """One table; a narrow terminal breaks the first column and the last."""
    table = Table(box=None, padding=(0, 1, 0, 0))
    last = len(header) - 1
    for i, name in enumerate(header):
        table.add_column(escape(name), no_wrap=0 < i < last, min_width={0: 13, last: 8}.get(i))
    for row in rows:
        table.add_row(*(escape(_narrow(cell)) for cell in row))
    console.print(table)


def _narrow(text: str) -> str:
    """Titles as a terminal shows them."""
    return text.replace(", fixed solid modes", ", fixed")
