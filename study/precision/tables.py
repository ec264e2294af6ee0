"""Tables of ``softgrasp study``: the points of every question, slopes, and points.csv."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import numpy as np

from softgrasp.fem import Scene
from softgrasp.reduction import METHODS
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.precision.fit import Slope, pareto
from softgrasp.study.precision.points import (
    BasisPoint,
    ForwardPoint,
    ReducedPoint,
    ReducedRiccatiPoint,
    RiccatiPoint,
    RunPoint,
    WorkPoint,
)
from softgrasp.study.precision.result import (
    ErrorBudget,
    Question,
    ReducedReference,
    RiccatiReference,
    WorkStudy,
)
from softgrasp.study.precision.riccati import TITLES as METHOD_TITLES
from softgrasp.study.report import Share, Table, percent

SERIES_TITLES: dict[str, dict[str, str]] = {
    "reduced": {key: method.title for key, method in METHODS.items()},
    "riccati": METHOD_TITLES,
    "reduced_riccati": BASIS_TITLES,
}


def front_of(points: Sequence[WorkPoint]) -> list[WorkPoint]:
    """The Pareto front; of reduced models, that of the error against their own full run."""
    return [*pareto([p for p in points if isinstance(p, ReducedPoint)], y="error_outputs_full")] or pareto(points)


def _title(p: WorkPoint | Slope) -> str:
    return SERIES_TITLES.get(p.question, {}).get(p.series, p.series)


def _error(point: RunPoint) -> Share | str:
    """The error, or below what it is where that of the reference is the larger one."""
    low, high = point.error_range
    return f"< {percent(high)}" if low == 0 and np.isfinite(high) else Share(point.error)


def _share(name: str) -> Callable[[Any], Share]:
    return lambda p: Share(getattr(p, name))


# Of every question: the columns with the attribute, or the function, that gives their cells.
COLUMNS: dict[str, dict[str, str | Callable[[Any], Any]]] = {
    "forward": {
        "setting": "label", "unknowns": "n_e", "deform. error": _error, "displ. error": _share("error_displacement"),
        "assembly [s]": "assembly", "factor [s]": "factor", "step [us]": lambda p: 1e6 * p.per_step,
        "run [s]": "seconds",
    },
    "reduced": {
        "setting": _title, "N": "N", "deform. error": _share("error_outputs_full"), "state error": _share("error_full"),
        "deform. error with the mesh": _error, "online [s]": "seconds", "from nothing [s]": "scratch",
    },
    "bases": {
        "engine": _title, "tolerance": "tolerance", "vectors": "columns", "left of the snapshots": "error",
        "|U'U - I|": "orthonormality", "time [s]": "seconds",
    },
    "riccati": {
        "method": _title, "tolerance": lambda p: None if p.series == "dense" else p.tolerance,
        "gain error": _share("error"), "residual": "residual", "rank": "rank", "solves": "solves",
        "time [s]": "seconds",
    },
    "reduced_riccati": {
        "basis": _title, "N": "N", "gain error": _share("error"), "excess cost": _share("cost_excess"),
        "abscissa [1/s]": "abscissa_full", "equation [ms]": lambda p: 1e3 * p.seconds, "from nothing [s]": "scratch",
    },
}  # fmt: skip


def question_table(name: str, points: Sequence[WorkPoint]) -> Table:
    """Points of a question; what is not finite is a dash."""
    front, columns = front_of(points), COLUMNS[name]

    def cells(p: WorkPoint) -> tuple[Any, ...]:
        row = [getattr(p, column) if isinstance(column, str) else column(p) for column in columns.values()]
        return tuple("-" if c is None or (isinstance(c, float) and not np.isfinite(c)) else c for c in row)

    marks = ["*" if p in front else "" if p.ok else _why(p) for p in points]
    best = [i for i, p in enumerate(points) if p in front]
    rows = [(*cells(p), mark) for p, mark in zip(points, marks, strict=True)]
    return Table((*columns, "front"), rows, best=best)


def _why(p: WorkPoint) -> str:
    """What is wrong with a point, in a word or two."""
    match p:
        case ForwardPoint():
            return "too slow"
        case RiccatiPoint():
            return "not reached"
        case ReducedRiccatiPoint():
            return "no solution" if p.reason else "unstable" if p.certified else "not certified"
    return "missed" if isinstance(p, BasisPoint) else "unstable"


def budget_table(budget: ErrorBudget) -> Table:
    """Every part with its share, what halves it at which cost, and its digits below a tenth of the largest part."""
    rows: list[tuple[Any, ...]] = [
        (p.name, percent(p.error), percent(p.share) if p.share > 1e-3 else "< 0.1 %", p.halved_by or "-",
         "-" if p.cost is None else f"{p.cost:.2g} x", p.wasted or "-")
        for p in budget.parts
    ]  # fmt: skip
    rows += [(name, "-", "-", reason, "-", "-") for name, reason in budget.missing]
    header = ("error of", "relative", "share", "halved by", "in a time of", "wasted digits")
    return Table(header, rows, f"Error budget of {budget.label}")


def slope_table(study: WorkStudy) -> Table:
    """Question, series, what against what, power, points."""
    rows = [
        (s.question.replace("_", " "), _title(s), s.against, f"{s.power:+.2f}",
         "" if s.expected is None else f"{s.expected:+.2f}", s.count)
        for s in study.slopes
    ]  # fmt: skip
    return Table(("question", "series", "of", "power", "theory", "points"), rows, "slopes, x^power")


def points_table(study: WorkStudy) -> Table:
    """All points of all questions; no mark for the front where there is no diagram."""
    rows = [*chain.from_iterable(question.rows for question in study.questions.values())]
    rows += [p.to_row() for p in study.measured_for_the_answers]
    first = ("question", "series", "label", "seconds", "error", "ok", "pareto")
    names = tuple(dict.fromkeys((*first, *chain.from_iterable(rows))))
    return Table(names, [[row.get(name) for name in names] for row in rows])


PAPER_ARE, PAPER_SMALL, PAPER_N = 84.53, 0.053, 8  # [s], [s]: the paper, section 4.2, 2n = 880
CAPTIONS = {
    "forward": (
        "Relative error of the deformation, the outputs against the hand over the run, against the time of a whole run "
        "(mesh, assembly, factor, steps). In the grey band the error of the reference is the larger one. "
        "Along a thin line the mesh stays and the steps grow; open marks: even meshes. Right: error against the "
        "unknowns, with the order in n_e^(1/d) and in brackets that of the theory, 2 alpha at the singular ends on "
        "even meshes; change through the time step on every mesh."
    ),
    "reduced": (
        "Relative error of the deformation, the outputs against the hand, against the full run on the same mesh and "
        "steps. Left: time of one reduced run "
        "once the model is there. Right: with everything before it. Open marks: the hand is part of the basis. "
        "Unstable models are left out."
    ),
    "bases": "What a basis leaves of the snapshots against the time to make it; open marks miss it.",
    "budget": "Time of single steps against the error of the deformation, with the budget.",
    "riccati": (
        "Left: relative error of the gain, Frobenius norm in the coordinates of the paper, against the tightest "
        "solution of another method. Right: true residual, recomputed from the factor. Along a line the tolerance "
        "falls. Galerkin bounds the change of its gain instead of the residual; the dense solver has no tolerance."
    ),
    "reduced_riccati": (
        "Gains of the reduced equations on the full plant: error of the gain and excess cost J(K^)/J(K) - 1 from the "
        "scene's start, against N and against the time of the reduced equation alone. Marks on the upper edge: error "
        "above 1; crosses: the full closed loop is not stable, or not certified to be."
    ),
}


def paper_of(scene: Scene) -> str:
    """Which scene of the paper this is, so that its own numbers may stand beside ours: forward, control, or neither."""
    if scene.name == "paper_forward" and scene.tissue.cells == [15, 30] and scene.time.steps == 600:
        return "forward"
    return "control" if scene.name.startswith("paper_lqr") and scene.tissue.cells == [10, 20] else ""


def reference_text(question: Question, paper: bool) -> str:
    """What the points of a question about feedback are compared with, and in its own scene the paper's numbers."""
    match question.reference:
        case RiccatiReference() as r:
            apart = "no second method converged, so that its own error is not known"
            if r.error is not None:
                apart = f"their gains differ by {percent(r.error)}, which is the estimated error of both"
            text = f"Reference: {' and '.join(r.names)}; {apart}. No method is compared with itself."
            return text + (f" The paper: {PAPER_ARE} s, 2n = 880, on its own machine." if paper else "")
        case ReducedReference() as r:
            text = f"Reference: the gain by {r.method}, with the residual {r.residual:.1e}"
            if r.error is not None:
                text += f"; the tightest solution of another method differs by {percent(r.error)}"
            text += f". The optimal cost from the scene's start is {r.optimal:.6g}."
            theirs = f" The paper: {1e3 * PAPER_SMALL:.0f} ms at N = {PAPER_N} with the POD of P, on its own machine."
            return text + (theirs if paper else "")
    return ""
