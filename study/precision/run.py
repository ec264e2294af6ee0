"""``softgrasp study``: what accuracy costs in time, and the cheapest setting for a tolerance or a budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.progress import TaskProgressColumn

from softgrasp.fem import Model, ResourceError, Scene, SceneError, SolverError, adapt, interruptible, scene_ends
from softgrasp.lqr import BASES, ControlError
from softgrasp.reduction import ENGINES
from softgrasp.study.precision.answer import Answers
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.forward import SHARES, ask_forward, mesh_series, solver_settings
from softgrasp.study.precision.full import FullRuns, find_places
from softgrasp.study.precision.points import CONTROL, ForwardPoint, ReducedPoint, Request, RunPoint
from softgrasp.study.precision.predict import Predictor, error_budget
from softgrasp.study.precision.reduced import ReducedRuns, ask_bases, ask_reduced
from softgrasp.study.precision.reference import LADDER, make_reference
from softgrasp.study.precision.result import Answer, ErrorBudget, Question, ReferenceSolution, WorkStudy
from softgrasp.study.precision.riccati import ControlRuns, ask_reduced_riccati, ask_riccati, settings_of
from softgrasp.study.precision.settings import own_setting, variant
from softgrasp.study.reduce.linear.measure import chosen_methods
from softgrasp.study.shell import Session, folder_lock

FULL_SNAPSHOTS = 3e8  # entries; beyond them the scene's own run is too large for reduced models in memory


@folder_lock()
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
    empty: bool = False,
) -> dict[str, Any]:
    """Measure accuracy against time for a scene file and write the results. Collective.

    Points are kept in ``out/cache``; the same command after an interruption goes on from there.

    Args:
        path, out, overrides, console, quiet, empty: see :class:`softgrasp.study.shell.session.Session`.
        tolerance, budget, questions: see :class:`softgrasp.study.precision.points.Request`.

    Raises:
        SoftgraspError: with one sentence.
    """
    session = Session("study", path, overrides, out, console, quiet, empty=empty)
    request = Request(tolerance, budget, tuple(questions or ()))
    scene = session.scene()
    scene.refuse_contact("study")
    scene.refuse_frame("study")
    if scene.effects.finite_strain is not None:
        raise SceneError(
            f"{path}: study compares methods of linear elasticity; set effects.finite_strain to false, or run reduce, "
            "which has models of finite strain"
        )
    with session.progress(TaskProgressColumn()) as bar:
        task = bar.add_task("study", total=1.0)

        def progress(label: str, share: float) -> None:
            bar.update(task, completed=share, description=label)

        study = study_scene(scene, session.comm, out / "cache", request, progress)
    from softgrasp.study.precision.page import write_study  # brings Matplotlib

    return write_study(session, study, request)


def study_scene(
    scene: Scene,
    comm: MPI.Intracomm,
    cache: Path,
    request: Request | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> WorkStudy:
    """Reference, points of every question, slopes and answers. Collective.

    Raises:
        SoftgraspError: a scene that cannot be built, a failed solve, or an interruption.
    """
    request = request or Request()
    names = request.questions
    model = adapt.build(variant(scene, own_setting(scene)), comm=comm)
    store = Cache(cache, comm, scene, progress)
    runs = FullRuns(scene, find_places(scene, model), model.system.layout.reference, store)
    control = ControlRuns(model, store, request.names)
    refused = control.refused() if set(names) & set(CONTROL) else ""
    questions = {name: Question(skipped=refused) for name in names if name in CONTROL}
    truth: ReferenceSolution | None = None
    answers: list[Answer] = []
    measured: list[RunPoint] = []
    with interruptible(False) as store.stop:
        store.count = count_points(scene, control, [name for name in names if not (refused and name in CONTROL)])
        if set(names) - set(CONTROL):
            truth = make_reference(runs, request.tolerance)
            questions |= forward_questions(model, runs, truth, names)
            answers, measured = answer(runs, truth, questions, request)
        if not refused:
            questions |= control_questions(control, names)
    budgets = error_budgets(scene, runs.dimension, questions, answers, measured) if "forward" in questions else ()
    return WorkStudy(
        scene=scene,
        truth=truth,
        questions={name: questions[name] for name in names},
        answers=tuple(answers),
        error_budgets=budgets,
        measured_for_the_answers=tuple(measured),
        measured=store.misses,
        cached=store.hits,
    )


def forward_questions(
    model: Model, runs: FullRuns, truth: ReferenceSolution, names: Sequence[str]
) -> dict[str, Question]:
    """Full model, reduced models, and bases. Collective."""
    questions = {}
    if "forward" in names:
        questions["forward"] = ask_forward(runs, truth, scene_ends(runs.cache.comm, model.space.mesh, model.scene))
    asks = {"reduced": ask_reduced, "bases": ask_bases}
    if not set(names) & set(asks):
        return questions
    reduced = ReducedRuns(own_setting(runs.scene), runs, truth)
    reason = "the snapshots of the scene's own run would not fit in memory"
    fits = 2.0 * reduced.timed.n_e * reduced.timed.steps <= FULL_SNAPSHOTS
    return questions | {
        name: ask(reduced) if fits else Question(reference=reduced.timed, skipped=reason)
        for name, ask in asks.items()
        if name in names
    }


def answer(
    runs: FullRuns, truth: ReferenceSolution, questions: dict[str, Question], request: Request
) -> tuple[list[Answer], list[RunPoint]]:
    """Answers to the tolerance and the budget, and the points that were measured for them. Collective."""
    if request.tolerance is None and request.budget is None:
        return [], []
    points = [p for name in ("forward", "reduced") for p in questions[name].points]
    forward = [p for p in points if isinstance(p, ForwardPoint)]
    answers = Answers(runs, truth, forward, [p for p in points if isinstance(p, ReducedPoint)])
    by_tolerance = [] if request.tolerance is None else [answers.tolerance(request.tolerance)]
    by_budget = [] if request.budget is None else [answers.budget(request.budget)]
    return by_tolerance + by_budget, answers.measured


def error_budgets(
    scene: Scene,
    dimension: int,
    questions: dict[str, Question],
    answers: Sequence[Answer],
    measured: Sequence[RunPoint],
) -> tuple[ErrorBudget, ...]:
    """Of the scene's own setting, and of the one that answers a tolerance."""
    points = [*measured, *(p for question in questions.values() for p in question.points)]
    skipped = {name: question.skipped for name, question in questions.items() if question.skipped}
    predictor = Predictor(scene, [p for p in points if isinstance(p, ForwardPoint)], dimension)
    answered = [a.full.point.setting for a in answers if a.kind == "tolerance" and a.full is not None]
    settings = dict.fromkeys([own_setting(scene), *answered])
    return tuple(error_budget(predictor, setting, points, skipped) for setting in settings)


def control_questions(control: ControlRuns, names: Sequence[str]) -> dict[str, Question]:
    """Riccati equation and reduced equations; one that fails is left out with its reason. Collective."""
    questions = {}
    asks = {"riccati": ask_riccati, "reduced_riccati": ask_reduced_riccati}
    for name, ask in asks.items():
        if name in names:
            try:
                questions[name] = ask(control)
            except (SolverError, ControlError, ResourceError) as error:
                questions[name] = Question(skipped=str(error))
    return questions


def count_points(scene: Scene, control: ControlRuns, names: Sequence[str]) -> int:
    """About how many points the questions have, for the time left."""
    d = control.layout.dimension
    counts = {
        "forward": sum(map(len, mesh_series(scene, d))) * len(SHARES) + len(solver_settings(scene)),
        "reduced": 1 + len(chosen_methods(scene)),
        "bases": 1 + len(ENGINES),
        "riccati": 1 + len(settings_of(control)),
        "reduced_riccati": 1 + len(BASES),
    }
    truth = len(LADDER) if set(names) - set(CONTROL) else 0
    return truth + sum(counts[name] for name in names) or 1
