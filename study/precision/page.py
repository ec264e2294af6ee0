"""What ``softgrasp study`` writes and prints: result.json, points.csv, pictures, report; tables and answers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

from softgrasp.study.precision import plots
from softgrasp.study.precision.answer import seconds_text
from softgrasp.study.precision.full import TimedRun
from softgrasp.study.precision.points import (
    CONTROL,
    TITLES,
    BasisPoint,
    ForwardPoint,
    ReducedPoint,
    ReducedRiccatiPoint,
    Request,
    RiccatiPoint,
)
from softgrasp.study.precision.result import RiccatiReference, WorkStudy
from softgrasp.study.precision.tables import (
    CAPTIONS,
    budget_table,
    front_of,
    paper_of,
    points_table,
    question_table,
    reference_text,
    slope_table,
)
from softgrasp.study.reduce.linear.measure import PAPER_FULL, PAPER_REDUCED
from softgrasp.study.report import EQUATION, Page, Section, control_equation, percent, to_json
from softgrasp.study.report.origin import command_line, origin, peak_memory_mb
from softgrasp.study.shell import Session

PAPER = f"{PAPER_REDUCED} s and a state error of about 1e-3 at N = 14"


def write_study(session: Session, study: WorkStudy, request: Request) -> dict[str, Any]:
    """Write and print everything on rank 0; the result on all ranks. Collective.

    Raises:
        OSError: the folder cannot be written; on all ranks.
    """
    comm = session.comm
    commands = [
        {
            name: command_line(choice.command, session.path, [*session.overrides, *choice.sets], comm.size)
            for name, choice in answer.choices.items()
        }
        for answer in study.answers
    ]
    answers = [
        {"kind": a.kind, "asked": a.limit, "met": a.met, "sentences": list(a.sentences), "closest": None}
        | {name: choice.to_dict(lines[name]) for name, choice in a.choices.items()}
        for a, lines in zip(study.answers, commands, strict=True)
    ]
    result = {
        "command": "study",
        **origin(study.scene, comm.size),
        **study.to_dict(),
        "answers": to_json(answers),
        "memory_peak_mb": peak_memory_mb(comm),
        "time": {"total": comm.allreduce(time.perf_counter() - session.begin, MPI.MAX)},
    }

    def page() -> Page:
        figures = draw(study, request.budget, session.out)
        parts = _sections(study, commands, {f.stem: f for f in figures if f.suffix == ".png"})
        missed = [answer.sentences[0] for answer in study.answers if not answer.met]
        return Page(
            f"{study.scene.name}: accuracy against time", summary(study), parts, {"points.csv": points_table(study)},
            figures, request.options, errors=[a.sentences[0] for a in study.answers if a.met], warnings=missed,
        )  # fmt: skip

    session.write(study.scene, result, page)
    comm.Barrier()
    return result


def summary(study: WorkStudy) -> list[str]:
    """What came out, in three sentences."""
    texts = []
    for name, question in study.questions.items():
        if front := front_of(question.points):
            (slow, low), (fast, high) = ((seconds_text(p.seconds), percent(p.error)) for p in (front[-1], front[0]))
            texts.append(
                f"{TITLES[name]}: {len(front)} of {len(question.points)} points are beaten by no other, from an error "
                f"of {high} in {fast} to {low} in {slow}."
            )
    if study.truth is not None:
        texts.append(f"The reference itself has an error of {percent(study.truth.error)} of the deformation.")
    return [*texts, f"{study.measured} runs were measured, {study.cached} come from the cache."]


def draw(study: WorkStudy, budget: float | None, out: Path) -> list[Path]:
    """All figures that have points. Rank 0 only."""
    files: list[Path] = []
    paper = paper_of(study.scene)
    forward, reduced, bases = study.of(ForwardPoint), study.of(ReducedPoint), study.of(BasisPoint)
    riccati, small_riccati = study.of(RiccatiPoint), study.of(ReducedRiccatiPoint)
    references = {name: question.reference for name, question in study.questions.items()}
    if forward and study.truth is not None:
        slopes, png = study.questions["forward"].slopes, out / "work_forward.png"
        files += plots.figure_forward(forward, slopes, study.truth.error, paper == "forward", png)
    if reduced and isinstance(full := references["reduced"], TimedRun):
        files += plots.figure_reduced(reduced, full.seconds, paper == "forward", out / "work_reduced.png")
    if bases:
        files += plots.figure_series(bases, "time of the basis [s]", "left of the snapshots", out / "work_bases.png")
    if riccati and isinstance(tight := references["riccati"], RiccatiReference):
        files += plots.figure_riccati(riccati, tight.error, paper == "control", out / "work_riccati.png")
    if small_riccati:
        files += plots.figure_reduced_riccati(small_riccati, paper == "control", out / "work_reduced_riccati.png")
    if budget is not None:
        every = [*forward, *reduced, *study.measured_for_the_answers]
        files += plots.figure_budget(every, budget, out / "work_budget.png")
    return files


def _left_out(study: WorkStudy) -> list[tuple[str, str]]:
    """Questions without points, and the reason, each reason once."""
    names: dict[str, list[str]] = {}
    for name, reason in study.skipped.items():
        names.setdefault(reason, []).append(TITLES[name])
    return [(", ".join(titles), reason) for reason, titles in names.items()]


def _sections(study: WorkStudy, commands: list[dict[str, str]], figures: dict[str, Path]) -> list[Section]:
    """Parts of the page."""
    sections = [
        Section("Answer", "\n\n".join(answer.sentences), "\n".join(lines.values()), terminal=True)
        for answer, lines in zip(study.answers, commands, strict=True)
    ]
    truth = study.truth
    if truth is not None:
        rows = [(f"error estimate, {name}", f"{percent(a)} of the deformation, {percent(b)} of the displacement")
                for name, (a, b) in truth.parts.items()]  # fmt: skip
        rows.append(("runs behind it", "; ".join(s.label for s in truth.settings)))
        sections.append(Section("Reference", text=truth.note, rows=rows, terminal=True))
    for budget in study.error_budgets:
        sections.append(budget_table(budget).section(budget.sentence, terminal=True))
    answered = {name: question for name, question in study.questions.items() if question.points}
    feedback = [name for name in answered if name in CONTROL]
    if feedback and len(feedback) == len(answered):
        # nothing follows the scene's own motion
        sections.insert(0, Section(EQUATION, equation=control_equation(study.scene)))
    for name, question in answered.items():
        if feedback and len(feedback) < len(answered) and name == feedback[0]:
            sections.append(Section(f"{EQUATION} under feedback", equation=control_equation(study.scene)))
        drawn = [(figures[f"work_{name}"], CAPTIONS[name])] if f"work_{name}" in figures else []
        text = reference_text(question, paper_of(study.scene) == "control")
        sections.append(question_table(name, question.points).section(text, TITLES[name], figures=drawn, terminal=True))
    sections += [Section("Left out", f"{titles}: {reason}.", terminal=True) for titles, reason in _left_out(study)]
    if "work_budget" in figures:
        sections.append(Section("Budget", figures=[(figures["work_budget"], CAPTIONS["budget"])]))
    sections.append(slope_table(study).section(title="Slopes", terminal=True))
    return [*sections, Section("How it is measured", rows=_how(study))]


def _how(study: WorkStudy) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    if study.truth is not None:
        rows += [
            ("deform. error", "max over the run of |y - y*|, over max |y*|; y the outputs against the hand"),
            ("displ. error", "the same of the whole displacements, where the hand's motion hides the tissue"),
            ("places", "the same points of the body on every mesh, not the nearest nodes"),
            ("time of a run", "mesh, assembly, factor and all steps; slowest rank; medians"),
        ]
    if sizes := [p.n_e for p in study.of(ForwardPoint)]:
        rows.append(("tissue n_e, settings tried", f"{min(sizes)} to {max(sizes)}"))
    rows += [
        ("repeats", f"{study.scene.study.repeats}; of a run, the first is the whole run, the others its first steps"),
        ("front", "no other point is faster and more accurate"),
    ]
    if paper_of(study.scene) == "forward":
        here = [q.reference for q in study.questions.values() if isinstance(q.reference, TimedRun)]
        ours = f" ({here[0].seconds:.3g} s here)" if here else ""
        rows.append(("the paper", f"{PAPER_FULL} s for the full run{ours}, {PAPER}, on its own machine"))
    return rows
