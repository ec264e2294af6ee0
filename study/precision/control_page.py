"""Tables and words of ``softgrasp study`` about feedback, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.precision.control_plots import (
    PAPER_ARE,
    PAPER_N,
    PAPER_SMALL,
    figure_loop,
    figure_reduced_riccati,
    figure_riccati,
)
from softgrasp.study.precision.fit import pareto
from softgrasp.study.precision.points import CONTROL, TITLES, Row, WorkPoint
from softgrasp.study.precision.riccati import TITLES as METHOD_TITLES
from softgrasp.study.report.page import Section

Rows = list[tuple[Any, ...]]
PAPER_SCENE = "paper_lqr"
HEADERS: dict[str, tuple[str, ...]] = {
    "riccati": ("method", "tolerance", "gain error", "residual", "rank", "solves", "time [s]", "front"),
    "reduced_riccati": (
        "basis", "N", "gain error", "excess cost", "abscissa [1/s]", "equation [ms]", "from nothing [s]", "front",
    ),
    "loop": (
        "controller", "steps", "error", "displacement", "error in time", "error of the cost", "step [us]", "run [s]",
        "front",
    ),
}  # fmt: skip
CAPTIONS = {
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
    "loop": (
        "Left: largest error of the deformation, the outputs against the hand, against the optimal loop without any "
        "time step, over its largest deformation; along a line the step falls. Solid: feedback inside the midpoint "
        "rule; dashed: sampled at every step and held; open marks: the reduced plant instead of the full one. Upper "
        "right: error against the same gain without time step. Steps longer than a period of the tissue do not resolve "
        "what the start excites. Lower right: seconds of a step, range over all steps and median."
    ),
}


def is_paper(scene: Scene) -> bool:
    """Whether the paper's times belong into the figures. Not collective."""
    return scene.name.startswith(PAPER_SCENE) and scene.tissue.cells == [10, 20]


def _number(value: Any) -> Any:
    return "-" if value is None or value in (float("inf"), float("-inf")) else value


def rows_of_control(name: str, points: Sequence[WorkPoint], front_only: bool = False) -> Rows:
    """Table rows under ``HEADERS[name]``. Not collective."""
    front, rows = pareto(points), []
    for p in front if front_only else points:
        d = p.details
        mark = "*" if p in front else "" if p.ok else _why(name, p)
        cells: tuple[Any, ...]
        if name == "riccati":
            cells = (METHOD_TITLES[p.series], _number(d["tolerance"] if p.series != "dense" else None), p.error,
                     d["residual"], d.get("rank"), d.get("solves"), p.seconds)  # fmt: skip
        elif name == "reduced_riccati":
            cells = (BASIS_TITLES.get(p.series, p.series), d["N"], p.error, d["cost_excess"], d["abscissa_full"],
                     1e3 * p.seconds, d["scratch"])  # fmt: skip
        else:
            step = None if d["per_step"] is None else 1e6 * d["per_step"]
            errors = p.error, d["error_displacement"], d["error_time"]
            cells = (p.series, d["steps"], *errors, d["cost_error"], step, p.seconds)
        rows.append((*(_number(c) for c in cells), mark))
    return rows


def _why(name: str, p: WorkPoint) -> str:
    """What is wrong with a point, in a word or two."""
    if name == "riccati":
        return "not reached"
    if p.details["reason"]:
        return "no solution" if name == "reduced_riccati" else "lost"
    if name == "reduced_riccati" and not p.details["certified"]:
        return "not certified"
    return "unstable" if name == "reduced_riccati" else "full plant not stable"


def notes(scene: Scene, references: dict[str, Row]) -> dict[str, str]:
    """The reference of each question with its own error, and the paper's numbers. Not collective."""
    found, paper = {}, is_paper(scene)
    if "riccati" in references:
        r = references["riccati"]
        apart = "no second method converged, so that its own error is not known"
        if r["error"] is not None:
            apart = f"their gains differ by {r['error']:.1e}, which is the estimated error of both"
        text = f"Reference: {' and '.join(r['names'])}; {apart}. No method is compared with itself."
        found["riccati"] = text + (f" The paper: {PAPER_ARE} s, 2n = 880, on its own machine." if paper else "")
    if "reduced_riccati" in references:
        r = references["reduced_riccati"]
        text = f"Reference: the gain of {r['method'].split(':')[0]} with the residual {r['residual']:.1e}"
        if r["error"] is not None:
            text += f"; the tightest solution of another method differs by {r['error']:.1e}"
        text += f". The optimal cost from the scene's start is {r['optimal']:.6g}."
        small = f" The paper: {1e3 * PAPER_SMALL:.0f} ms at N = {PAPER_N} with the POD of P, on its own machine."
        found["reduced_riccati"] = text + (small if paper else "")
    if "loop" in references:
        r = references["loop"]
        text = "Reference: the optimal loop by the matrix exponential on "
        own = f"all {r['modes']} modes, exact but for rounding"
        if not r["complete"]:
            own = f"the {r['modes']} lowest modes; with half of them the outputs change by {r['error']:.1e}"
        found["loop"] = text + own + ". Limits and delay of the scene are left out; held means one sample a step."
    return found


def draw_control(points: dict[str, tuple[WorkPoint, ...]], references: dict[str, Row], scene: Scene, out: Path
                 ) -> list[Path]:  # fmt: skip
    """All figures about feedback that have points. Rank 0 only."""
    found: list[Path] = []
    paper = is_paper(scene)
    errors = {k: float("nan") if r["error"] is None else float(r["error"]) for k, r in references.items()}
    if points.get("riccati"):
        found += figure_riccati(points["riccati"], errors["riccati"], paper, out / "work_riccati.png")
    if points.get("reduced_riccati"):
        png = out / "work_reduced_riccati.png"
        found += figure_reduced_riccati(points["reduced_riccati"], paper, png)
    if points.get("loop"):
        found += figure_loop(points["loop"], errors["loop"], out / "work_loop.png")
    return found


def control_sections(
    points: dict[str, tuple[WorkPoint, ...]], references: dict[str, Row], scene: Scene, out: Path, drawn: set[str]
) -> list[Section]:
    """Figures and tables of the report. Not collective."""
    words, found = notes(scene, references), []
    for name in CONTROL:
        if not points.get(name):
            continue
        picture = f"work_{name}.png"
        figures = [(out / picture, CAPTIONS[name])] if picture in drawn else []
        found.append(Section(TITLES[name], text=words.get(name, ""), figures=figures))
        found.append(Section("", header=HEADERS[name], rows=rows_of_control(name, points[name])))
    return found
