"""Files of ``softgrasp study``: result.json, points.csv, pictures and report; and what the terminal shows."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from softgrasp.fem.errors import agree
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.study.precision.answer import Answer, seconds_text
from softgrasp.study.precision.control_page import HEADERS, control_sections, draw_control, notes, rows_of_control
from softgrasp.study.precision.fit import pareto
from softgrasp.study.precision.plots import figure_budget, figure_forward, figure_reduced, figure_series
from softgrasp.study.precision.points import CONTROL, TITLES, Asked, Row, WorkPoint
from softgrasp.study.precision.tables import (
    FORWARD_HEADER,
    REDUCED_HEADER,
    forward_rows,
    reduced_rows,
    slope_rows,
)
from softgrasp.study.reduce.times import PAPER_FULL, PAPER_REDUCED
from softgrasp.study.report.equation_control import control_text
from softgrasp.study.report.files import plain, write_json, write_scene
from softgrasp.study.report.origin import command_line, made_with, origin, peak_memory_mb
from softgrasp.study.report.page import EQUATION, Section, write_report
from softgrasp.study.shell.session import list_files

if TYPE_CHECKING:
    from softgrasp.study.precision.reference import Reference
    from softgrasp.study.precision.run import WorkStudy

PAPER_SCENE = "paper_forward"
FIRST = ("question", "series", "label", "seconds", "error", "ok", "pareto")
CAPTIONS = {
    "work_forward.png": (
        "Relative error of the deformation, the outputs against the hand over the run, against the time of a whole run "
        "(mesh, assembly, factor, steps). In the grey band the error of the reference is the larger one. "
        "Along a thin line the mesh stays and the steps grow. Right: order in space at the most steps, and change "
        "through the time step on every mesh."
    ),
    "work_reduced.png": (
        "Relative error of the deformation, the outputs against the hand, against the full run on the same mesh and "
        "steps. Left: time of one reduced run "
        "once the model is there. Right: with everything before it. Open marks: the hand is part of the basis. "
        "Unstable models are left out."
    ),
    "work_bases.png": "What a basis leaves of the snapshots against the time to make it; open marks miss it.",
    "work_budget.png": "Time of single steps against the error of the deformation, with the budget.",
}


def is_paper(study: WorkStudy) -> bool:
    """Whether the paper's own points may be drawn in. Not collective."""
    return study.scene.name == PAPER_SCENE and study.scene.tissue.cells == [15, 30] and study.scene.time.steps == 600


def write_study(
    study: WorkStudy,
    comm: MPI.Intracomm,
    path: Path,
    out: Path,
    overrides: list[str],
    begin: float,
    asked: Asked,
) -> dict[str, Any]:
    """Write everything on rank 0; the result on all ranks. Collective.

    Raises:
        OSError: the folder cannot be written; on all ranks.
    """
    result: dict[str, Any] = {
        "command": "study",
        **origin(study.scene, comm.size),
        "repeats": study.scene.study.repeats,
        "reference": _reference(study.reference),
        "references": study.references,
        "points": {name: rows_of(points) for name, points in study.points.items()},
        "pareto": {name: [p.label for p in pareto(points)] for name, points in study.points.items()},
        "slopes": [vars(s) for s in study.slopes],
        "skipped": study.skipped,
        "answers": [_answer(a, path, overrides, comm.size) for a in study.answers],
        "measured_for_the_answers": [p.to_row() for p in study.tried],
        "runs": {"measured": study.measured, "cached": study.cached},
        "memory_peak_mb": peak_memory_mb(comm),
        "time": {"total": comm.allreduce(time.perf_counter() - begin, MPI.MAX)},
    }  # fmt: skip
    result = plain(result)
    files: list[str] = []
    with agree(comm):
        if comm.rank == 0:
            out.mkdir(parents=True, exist_ok=True)
            pictures = draw(study, asked.budget, out)
            report = _report(study, result, path, out, overrides, asked, pictures)
            rows = [*chain(*result["points"].values()), *result["measured_for_the_answers"]]
            table = write_csv(rows, out / "points.csv")
            numbers, scene = write_json(out / "result.json", result), write_scene(out, study.scene)
            files = [str(f) for f in (numbers, table, scene, *pictures, report)]
    result["files"] = comm.bcast(files)
    return result


def _answer(answer: Answer, path: Path, overrides: list[str], ranks: int) -> Row:
    """An answer for JSON, each of its settings with the command that runs it again. Not collective."""
    row = answer.to_dict()
    for part in (row.get("full"), row.get("reduced"), row["closest"]):
        if part is not None:
            part["command"] = command_line(part["command"], path, [*overrides, *part["set"]], ranks)
    return row


def _commands(row: Row) -> list[str]:
    """Commands that run what an answer names, in the order of its sentences. Not collective."""
    return [row[key]["command"] for key in ("full", "reduced", "closest") if row.get(key) is not None]


def _reference(truth: Reference | None) -> Row | None:
    """The reference of the forward questions for JSON. Not collective."""
    if truth is None:
        return None
    return {
        "note": truth.note, "error": truth.error, "error_displacement": truth.error_displacement,
        "space": truth.space, "time": truth.time, "mixed": truth.mixed, "order": truth.limit.order,
        "expected_order": truth.limit.expected, "extrapolated": truth.limit.extrapolated,
        "settings": [s.label for s in truth.settings],
    }  # fmt: skip


def rows_of(points: Sequence[WorkPoint]) -> list[Row]:
    """Table rows with a mark for the front. Not collective."""
    front = pareto(points)
    return [p.to_row() | {"pareto": p in front} for p in points]


def write_csv(rows: Sequence[Row], path: Path) -> Path:
    """All points of all questions in one table, numbers in full; no mark for the front where there is no diagram.

    Rank 0 only.
    """
    more = list(dict.fromkeys(key for row in rows for key in row if key not in FIRST))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*FIRST, *more], restval="")
        writer.writeheader()
        writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in rows)
    return path


def draw(study: WorkStudy, budget: float | None, out: Path) -> list[Path]:
    """All figures that have points. Rank 0 only."""
    found: list[Path] = []
    points, paper = study.points, is_paper(study)
    if points.get("forward") and study.reference is not None:
        found += figure_forward(points["forward"], study.slopes, study.reference.error, paper, out / "work_forward.png")
    if points.get("reduced"):
        found += figure_reduced(points["reduced"], study.full["seconds"], paper, out / "work_reduced.png")
    if points.get("bases"):
        found += figure_series(
            points["bases"], "time of the basis [s]", "left of the snapshots", out / "work_bases.png"
        )
    found += draw_control(study.points, study.references, study.scene, out)
    if budget is not None:
        every = {q: [*points.get(q, ()), *(p for p in study.tried if p.question == q)] for q in ("forward", "reduced")}
        found += figure_budget(every["forward"], every["reduced"], budget, out / "work_budget.png")
    return found


# --- terminal


def show(console: Console, study: WorkStudy, result: dict[str, Any]) -> None:
    """Print fronts, slopes and answers. Rank 0 prints."""
    if study.reference is not None:
        console.print(study.reference.note, markup=False)
    if study.points.get("forward"):
        rows = [r[:-1] for r in forward_rows(study.points["forward"], True)]
        _print(console, "full model, Pareto front", FORWARD_HEADER[:-1], rows)
    if study.points.get("reduced"):
        rows = [r[:-1] for r in reduced_rows(study.points["reduced"], True)]
        _print(console, "reduced models on the scene's own mesh, Pareto front", REDUCED_HEADER[:-1], rows)
    words = notes(study.scene, study.references)
    for name in CONTROL:
        if study.points.get(name):
            console.print(words.get(name, ""), markup=False)
            rows = [r[:-1] for r in rows_of_control(name, study.points[name], True)]
            _print(console, f"{TITLES[name]}, Pareto front", HEADERS[name][:-1], rows)
    _print(console, "slopes, x^power", ("question", "series", "of", "power", "points"), slope_rows(study.slopes))
    for reason, names in _left_out(study).items():
        console.print(f"{', '.join(names)}: left out, {reason}", markup=False)
    if is_paper(study) and study.full:
        console.print(
            f"The paper: {PAPER_FULL} s for the full run, here {study.full['seconds']:.3g} s; {PAPER_REDUCED} s and a "
            "state error of about 1e-3 at N = 14.",
            markup=False,
        )
    for answer, row in zip(study.answers, result["answers"], strict=True):
        style = "bold" if answer.met else "bold red"
        for k, sentence in enumerate(answer.sentences):
            console.print(sentence, style=style if k == 0 else None, markup=False, soft_wrap=True)
        for command in _commands(row):
            console.print(f"  {command}", markup=False, soft_wrap=True)
    runs = result["runs"]
    console.print(f"{runs['measured']} runs measured, {runs['cached']} from the cache", style="dim")
    list_files(console, [Path(file) for file in result["files"]])


def _left_out(study: WorkStudy) -> dict[str, list[str]]:
    """Questions without points by the reason. Not collective."""
    found: dict[str, list[str]] = {}
    for name, reason in study.skipped.items():
        found.setdefault(reason, []).append(TITLES[name])
    return found


def _print(console: Console, title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*(escape(f"{c:.3g}" if isinstance(c, float) else str(c)) for c in row))
    console.print(table)


# --- report


def _sizes(study: WorkStudy) -> list[tuple[str, Any]]:
    """The scene's own mesh and steps, and the span of what was tried. Rank 0 only."""
    tissue, time = study.scene.tissue, study.scene.time
    rows: list[tuple[str, Any]] = [
        ("cells", " x ".join(str(n) for n in tissue.cells) if tissue.cells else tissue.mesh),
        ("element", f"P{tissue.order}"),
        ("steps", f"{time.steps} to {study.scene.time_end:.6g} s"),
        ("layers", len(tissue.layers)),
    ]
    tried = sorted({int(p.details["n_e"]) for p in study.points.get("forward", ()) if p.details.get("n_e")})
    if tried:
        rows.append(("tissue n_e, settings tried", f"{tried[0]} to {tried[-1]}"))
    return [row for row in rows if row[1]]


def _report(
    study: WorkStudy,
    result: dict[str, Any],
    path: Path,
    out: Path,
    overrides: list[str],
    asked: Asked,
    pictures: Sequence[Path],
) -> Path:
    drawn = {p.name for p in pictures}
    sections = [
        Section("Answer", text="\n\n".join(a.sentences), code="\n".join(_commands(row)))
        for a, row in zip(study.answers, result["answers"], strict=True)
    ]
    if study.reference is not None:
        sections.append(Section("Reference", text=study.reference.note, rows=_reference_rows(study.reference)))
    sections.append(Section("Size", rows=_sizes(study)))
    tables: dict[str, tuple[Sequence[str], list[tuple[Any, ...]]]] = {
        "forward": (FORWARD_HEADER, forward_rows(study.points.get("forward", ()))),
        "reduced": (REDUCED_HEADER, reduced_rows(study.points.get("reduced", ()))),
        "bases": (
            ("engine", "tolerance", "vectors", "left of the snapshots", "|U'U - I|", "time [s]"),
            [
                (p.series, d["tolerance"], d["columns"], p.error, d["orthonormality"], p.seconds)
                for p in study.points.get("bases", ())
                for d in (p.details,)
            ],
        ),
    }
    for name, (header, rows) in tables.items():
        picture = f"work_{name}.png"
        figures = [(out / picture, CAPTIONS[picture])] if picture in drawn else []
        if rows:
            sections.append(Section(TITLES[name], figures=figures))
            sections.append(Section("", header=header, rows=rows))
    feedback = control_sections(study.points, study.references, study.scene, out, drawn)
    if feedback and all(name in CONTROL for name, found in study.points.items() if found):
        sections.insert(0, Section(EQUATION, code=control_text(study.scene)))  # nothing follows the scene's own motion
    elif feedback:
        sections.append(Section(f"{EQUATION} under feedback", code=control_text(study.scene)))
    sections += feedback
    for reason, names in _left_out(study).items():
        sections.append(Section("Left out", text=f"{', '.join(names)}: {reason}."))
    if "work_budget.png" in drawn:
        sections.append(Section("Budget", figures=[(out / "work_budget.png", CAPTIONS["work_budget.png"])]))
    slopes = slope_rows(study.slopes)
    sections.append(Section("Slopes", header=("question", "series", "of", "power", "points"), rows=slopes))
    sections.append(Section("How it is measured", rows=_how(study, result)))
    options = "" if asked.tolerance is None else f" --tolerance {asked.tolerance!r}"
    options += "" if asked.budget is None else f" --budget {asked.budget!r}s"
    options += f" --question {','.join(asked.names)}" if asked.names else ""
    return write_report(
        out / "report.html",
        title=f"{study.scene.name}: accuracy against time",
        subtitle=study.scene.description,
        sections=sections,
        scene=resolved_toml(study.scene),
        reproduce=command_line("study", path, overrides, result["ranks"], options),
    )


def _reference_rows(truth: Reference) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = [
        (f"error estimate, {name}", f"{a:.1e} of the deformation, {b:.1e} of the displacement")
        for name, (a, b) in (("space", truth.space), ("time", truth.time), ("mixed", truth.mixed))
    ]
    return [*rows, ("runs behind it", "; ".join(s.label for s in truth.settings))]


def _how(study: WorkStudy, result: dict[str, Any]) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    if study.reference is not None:
        rows += [
            ("error", "max over the run of |y - y*|, over max |y*|; y the outputs against the hand, the deformation"),
            ("displacement", "the same of the whole displacements, in which the motion of the hand hides the tissue"),
            ("places", "the same points of the body on every mesh, not the nearest nodes"),
            ("time of a run", "mesh, assembly, factor and all steps; slowest rank; medians"),
        ]
    rows += [
        ("repeats", f"{study.scene.study.repeats}; of a run, the first is the whole run, the others its first steps"),
        ("front", "no other point is faster and more accurate"),
    ]
    if is_paper(study):
        rows.append(
            (
                "the paper",
                f"{PAPER_FULL} s full, {PAPER_REDUCED} s and a state error of about 1e-3 at N = 14, own machine",
            )
        )
    seconds = seconds_text(result["time"]["total"])
    return [*rows, *made_with(result), ("time of this study", seconds)]
