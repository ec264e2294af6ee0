"""``softgrasp study``: what accuracy costs in time, and the cheapest setting for a tolerance or a budget."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from fem.build import build
from fem.scene import Scene
from fem.scene_file import load_scene_collective
from study.reduce_sweep import chosen_methods
from study.wp_answer import Answer, Asker
from study.wp_fit import Slope
from study.wp_forward import forward_settings, forward_slopes, sweep_forward
from study.wp_full import FullRuns
from study.wp_points import Cache, Guard, Row, WorkPoint, interruptible, variant
from study.wp_probe import find_places
from study.wp_reduced import own_setting, reduced_slopes, sweep_bases, sweep_reduced
from study.wp_reference import Reference, make_reference, nested_meshes

REDUCED_WORK = 5e5  # expected of a basis, in unknowns times steps
FULL_SNAPSHOTS = 3e8  # entries; beyond them the scene's own run is too large for reduced models in memory


@dataclass(frozen=True)
class WorkStudy:
    """All that one study found.

    Attributes:
        scene: the scene.
        reference: solution that outputs are compared with.
        points: of every question that was asked.
        slopes: fitted.
        skipped: questions without points, with the reason.
        full: row of the full run behind the reduced models.
        answers: to a tolerance and a budget.
        measured, cached: runs made now and taken from the cache.
    """

    scene: Scene
    reference: Reference
    points: dict[str, tuple[WorkPoint, ...]]
    slopes: tuple[Slope, ...]
    skipped: dict[str, str]
    full: Row
    answers: tuple[Answer, ...]
    measured: int
    cached: int


def run_study(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    tolerance: float | None = None,
    budget: float | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Measure accuracy against time for a scene file and write the results. Collective.

    Points are kept in ``out/cache``; the same command after an interruption goes on from there.

    Args:
        path: scene file.
        out: folder of the results.
        overrides: arguments of ``--set``.
        console: for the tables.
        tolerance: relative error of the outputs to answer for; None asks nothing.
        budget: seconds of a step to answer for; None asks nothing.
        quiet: no progress bar.

    Raises:
        SoftgraspError: with one sentence.
    """
    begin = time.perf_counter()
    comm = MPI.COMM_WORLD
    scene = load_scene_collective(comm, path, overrides)
    console.print(f"[bold]{scene.name}[/bold]: {scene.description}", soft_wrap=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("left"))
    with Progress(
        *columns, TimeRemainingColumn(), console=console, disable=quiet or not console.is_terminal, transient=True
    ) as bar:
        task = bar.add_task("study", total=1.0)

        def progress(label: str, share: float) -> None:
            bar.update(task, completed=share, description=label)

        found = study_scene(scene, comm, out / "cache", tolerance, budget, progress)
    from study.work_report import show, write_study  # brings Matplotlib

    result = write_study(found, comm, path, out, overrides, begin, (tolerance, budget))
    show(console, found, result)
    comm.Barrier()
    return result


def study_scene(
    scene: Scene,
    comm: MPI.Intracomm,
    cache: Path,
    tolerance: float | None = None,
    budget: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> WorkStudy:
    """Reference, points of every question, slopes and answers. Collective.

    Args:
        scene: the scene.
        comm: ranks.
        cache: folder of the cached points.
        tolerance: to answer for, or None.
        budget: seconds of a step to answer for, or None.
        progress: called before each point with its name and the share of work done.

    Raises:
        SoftgraspError: a scene that cannot be built, a failed solve, or an interruption.
    """
    names = chosen_methods(scene.reduction)
    model = build(variant(scene, own_setting(scene)), comm)
    places = find_places(scene, model)
    guard = Guard(comm, progress)
    runs = FullRuns(scene, places, model.system.layout.reference, Cache(cache, comm, scene), guard)
    guard.work = _expected(scene, runs, len(names), model.system.layout.dimension)
    with interruptible(guard):
        truth = make_reference(scene, runs)
        points: dict[str, list[WorkPoint]] = {"forward": sweep_forward(scene, runs, truth)}
        full = runs.run(own_setting(scene))
        skipped: dict[str, str] = {}
        if 2.0 * full["n_e"] * full["steps"] > FULL_SNAPSHOTS:
            skipped["reduced"] = skipped["bases"] = "the snapshots of the scene's own run would not fit in memory"
        else:
            points["reduced"] = sweep_reduced(scene, runs, truth, full, names)
            points["bases"] = sweep_bases(scene, runs, truth)
        answers = _answers(Asker(scene, runs, truth, points["forward"], points.get("reduced", [])), tolerance, budget)
    slopes = forward_slopes(points["forward"]) + reduced_slopes(points.get("reduced", []))
    return WorkStudy(
        scene=scene,
        reference=truth,
        points={name: tuple(each) for name, each in points.items()},
        slopes=tuple(slopes),
        skipped=skipped,
        full=full,
        answers=answers,
        measured=runs.cache.misses,
        cached=runs.cache.hits,
    )


def _expected(scene: Scene, runs: FullRuns, methods: int, d: int) -> float:
    """Expected work of the whole study, for the time left. Not collective."""
    meshes: tuple[tuple[int, ...] | None, ...] = nested_meshes(scene) or (None,)
    own = own_setting(scene)
    space = [runs.work(type(own)(cells, 2, own.steps)) for cells in meshes]
    points = sum(runs.work(s) for s in forward_settings(scene, d))
    return float(2 * sum(space) + points + REDUCED_WORK * (methods + 1))


def _answers(asker: Asker, tolerance: float | None, budget: float | None) -> tuple[Answer, ...]:
    found = []
    if tolerance is not None:
        found.append(asker.tolerance(tolerance))
    if budget is not None:
        found.append(asker.budget(budget))
    return tuple(found)
