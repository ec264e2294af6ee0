"""``softgrasp study``: what accuracy costs in time, and the cheapest setting for a tolerance or a budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.progress import TaskProgressColumn

from softgrasp.fem.errors import ResourceError, SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.interrupt import interruptible
from softgrasp.fem.scene.scene import Scene
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.bases import BASES
from softgrasp.reduction.engines import ENGINES
from softgrasp.study.precision.answer import Answer, Asker
from softgrasp.study.precision.fit import Slope
from softgrasp.study.precision.forward import forward_settings, forward_slopes, sweep_forward
from softgrasp.study.precision.full import FullRuns
from softgrasp.study.precision.loop import (
    CONTROLLERS,
    Controller,
    Feedback,
    LoopRuns,
    controller_work,
    loop_slopes,
    sweep_loop,
)
from softgrasp.study.precision.points import (
    CONTROL,
    QUESTIONS,
    Asked,
    Cache,
    Guard,
    Row,
    WorkPoint,
    number,
    variant,
)
from softgrasp.study.precision.probe import find_places
from softgrasp.study.precision.reduced import (
    bases_slopes,
    engine_work,
    own_setting,
    reduced_slopes,
    sweep_bases,
    sweep_reduced,
)
from softgrasp.study.precision.reference import Reference, make_plan, make_reference
from softgrasp.study.precision.riccati import SECOND, ControlRuns, riccati_slopes, riccati_work, sweep_riccati
from softgrasp.study.precision.riccati_reduced import (
    basis_work,
    reduced_riccati_slopes,
    reference_note,
    sweep_riccati_reduced,
)
from softgrasp.study.reduce.sweep import chosen_methods
from softgrasp.study.shell.session import open_scene, progress_bar

REDUCED_WORK = 5e5  # expected of a basis, in unknowns times steps
FULL_SNAPSHOTS = 3e8  # entries; beyond them the scene's own run is too large for reduced models in memory


@dataclass(frozen=True)
class WorkStudy:
    """All that one study found.

    Attributes:
        scene: the scene.
        reference: solution that outputs are compared with; None when no question needed it.
        points: of every question that was asked.
        slopes: fitted.
        skipped: questions without points, with the reason.
        full: row of the full run behind the reduced models; empty without them.
        references: of the questions of control, see :func:`study.precision.riccati.sweep_riccati` and its kin.
        answers: to a tolerance and a budget.
        tried: points that were measured for the answers.
        measured, cached: runs made now and taken from the cache.
    """

    scene: Scene
    reference: Reference | None
    points: dict[str, tuple[WorkPoint, ...]]
    slopes: tuple[Slope, ...]
    skipped: dict[str, str]
    full: Row
    references: dict[str, Row]
    answers: tuple[Answer, ...]
    tried: tuple[WorkPoint, ...]
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
    questions: Sequence[str] | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Measure accuracy against time for a scene file and write the results. Collective.

    Points are kept in ``out/cache``; the same command after an interruption goes on from there.

    Args:
        path: scene file.
        out: folder of the results.
        overrides: arguments of ``--set``.
        console: for the tables.
        tolerance: relative error of the deformation to answer for; None asks nothing.
        budget: seconds of a step to answer for; None asks nothing.
        questions: arguments of ``--question``, see :class:`study.precision.points.Asked`; None asks all.
        quiet: no progress bar.

    Raises:
        SoftgraspError: with one sentence.
    """
    begin = time.perf_counter()
    comm = MPI.COMM_WORLD
    asked = Asked(tolerance, budget, tuple(questions or ()))
    scene = open_scene(path, overrides, console)
    with progress_bar(console, TaskProgressColumn(), quiet=quiet) as bar:
        task = bar.add_task("study", total=1.0)

        def progress(label: str, share: float) -> None:
            bar.update(task, completed=share, description=label)

        found = study_scene(scene, comm, out / "cache", asked, progress)
    from softgrasp.study.precision.page import show, write_study  # brings Matplotlib

    result = write_study(found, comm, path, out, overrides, begin, asked)
    show(console, found, result)
    comm.Barrier()
    return result


def study_scene(
    scene: Scene,
    comm: MPI.Intracomm,
    cache: Path,
    asked: Asked | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> WorkStudy:
    """Reference, points of every question, slopes and answers. Collective.

    Args:
        scene: the scene.
        comm: ranks.
        cache: folder of the cached points.
        asked: questions, tolerance and budget; None asks all questions and nothing more.
        progress: called before each point with its name and the share of work done.

    Raises:
        SoftgraspError: a scene that cannot be built, a failed solve, or an interruption.
    """
    asked = asked or Asked()
    wanted = asked.questions
    model = build(variant(scene, own_setting(scene)), comm)
    guard = Guard(comm, progress)
    store = Cache(cache, comm, scene)
    control = ControlRuns(model, store, guard, asked.names) if set(wanted) & set(CONTROL) else None
    refused = control.refused() if control is not None else ""
    runs = FullRuns(scene, find_places(scene, model), model.system.layout.reference, store, guard)
    guard.work = 1.0
    if control is not None and not refused:
        guard.work += control_work(control, wanted)
    found = Found()
    if refused:
        found.skipped |= {q: refused for q in wanted if q in CONTROL}
    with interruptible() as guard.stop:
        if set(wanted) - set(CONTROL):
            guard.work += _expected(scene, runs, len(chosen_methods(scene.reduction)), model.system.layout.dimension)
            guard.work += sum(engine_work(scene, engine) for engine in ENGINES) if "bases" in wanted else 0.0
            forward_questions(scene, runs, asked, found)
        if control is not None and not refused:
            control_questions(control, wanted, found)
    return WorkStudy(
        scene=scene,
        reference=found.reference,
        points={name: tuple(found.points[name]) for name in QUESTIONS if name in found.points},
        slopes=tuple(found.slopes),
        skipped=found.skipped,
        full=found.full,
        references=found.references,
        answers=tuple(found.answers),
        tried=tuple(found.tried),
        measured=store.misses,
        cached=store.hits,
    )


@dataclass
class Found:
    """What the questions have given so far; see :class:`WorkStudy`."""

    reference: Reference | None = None
    points: dict[str, list[WorkPoint]] = field(default_factory=dict)
    slopes: list[Slope] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    full: Row = field(default_factory=dict)
    references: dict[str, Row] = field(default_factory=dict)
    answers: list[Answer] = field(default_factory=list)
    tried: list[WorkPoint] = field(default_factory=list)


def forward_questions(scene: Scene, runs: FullRuns, asked: Asked, found: Found) -> None:
    """Reference, full model, reduced models, bases, and the answers out of them. Collective."""
    wanted = asked.questions
    truth = found.reference = make_reference(scene, runs)
    if "forward" in wanted:
        found.points["forward"] = sweep_forward(scene, runs, truth)
        found.slopes += forward_slopes(found.points["forward"], truth.error)
    if set(wanted) & {"reduced", "bases"}:
        full = found.full = runs.run(own_setting(scene))
        if 2.0 * full["n_e"] * full["steps"] > FULL_SNAPSHOTS:
            reason = "the snapshots of the scene's own run would not fit in memory"
            found.skipped |= {q: reason for q in ("reduced", "bases") if q in wanted}
        else:
            if "reduced" in wanted:
                found.points["reduced"] = sweep_reduced(scene, runs, truth, full, chosen_methods(scene.reduction))
                found.slopes += reduced_slopes(found.points["reduced"])
            if "bases" in wanted:
                found.points["bases"] = sweep_bases(scene, runs, truth)
                found.slopes += bases_slopes(found.points["bases"])
    if asked.tolerance is None and asked.budget is None:
        return
    asker = Asker(scene, runs, truth, found.points["forward"], found.points.get("reduced", []))
    if asked.tolerance is not None:
        found.answers.append(asker.tolerance(asked.tolerance))
    if asked.budget is not None:
        found.answers.append(asker.budget(asked.budget))
    found.tried += asker.tried


def control_questions(control: ControlRuns, wanted: Sequence[str], found: Found) -> None:
    """Riccati equation, reduced equations, closed loop; one that fails is left out with its reason. Collective."""
    ask = {"riccati": _riccati, "reduced_riccati": _reduced_riccati, "loop": _loop}
    for name in (q for q in wanted if q in CONTROL):
        try:
            reference, points, slopes = ask[name](control)
        except (SolverError, ControlError, ResourceError) as error:
            found.skipped[name] = str(error)
            continue
        found.references[name], found.points[name] = reference, points
        found.slopes += slopes


def _riccati(control: ControlRuns) -> tuple[Row, list[WorkPoint], list[Slope]]:
    reference, points = control.reference_row(), sweep_riccati(control)
    return reference, points, riccati_slopes(points, number(reference["error"]))


def _reduced_riccati(control: ControlRuns) -> tuple[Row, list[WorkPoint], list[Slope]]:
    reference, points = reference_note(control), sweep_riccati_reduced(control)
    return reference, points, reduced_riccati_slopes(points, number(reference["error"]))


def _loop(control: ControlRuns) -> tuple[Row, list[WorkPoint], list[Slope]]:
    loops = LoopRuns(control)
    reference, points = loops.reference_row(), sweep_loop(loops)
    return reference, points, loop_slopes(points)


def control_work(control: ControlRuns, wanted: Sequence[str]) -> float:
    """Expected work of the questions of control, for the time left. Not collective."""
    work = 0.0
    if "riccati" in wanted:
        work += 2 * control.work + riccati_work(control)
    if "reduced_riccati" in wanted:
        work += 2 * control.work + len(BASES) * basis_work(control)
    if "loop" in wanted:
        loops = LoopRuns(control)
        work += control.work + SECOND + CONTROLLERS * controller_work(loops, Controller(Feedback()))
    return work


def _expected(scene: Scene, runs: FullRuns, methods: int, d: int) -> float:
    """Expected work of the forward questions, for the time left. Not collective."""
    settings = [*make_plan(scene).settings, *forward_settings(scene, d)]
    return float(sum(runs.work(s) for s in settings) + REDUCED_WORK * (methods + 1))
