"""The page of ``softgrasp query``: the answer, its three errors, and what a reader should be warned of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softgrasp.reduction import NORMS, Certificate, ParameterDomain
from softgrasp.study.query.answer import CertifiedAnswer, QueryResult, answer_rows
from softgrasp.study.report import Page, Section, Share, Table, captioned, in_words, percent
from softgrasp.study.shell import Session

CAPTIONS = {
    "answer.png": "Outputs against the hand with the band that the error bound leaves (often thinner than the line); "
    "largest error of the outputs so far, proved and estimated; the three errors beside the tolerance.",
    "errors.png": "The three errors of the reduced model beside the tolerance.",
    "answers.png": "Error of every answer against its material; crosses: refused. Frame: the box of the training.",
}


def compose(answers: QueryResult, session: Session, options: str) -> Page:
    """Draw the pictures, where a folder is written, and compose the page."""
    model, many, first = answers.model, answers.many, answers.each[0]
    shown = many or first.run is not None
    drawn: list[Path] = []
    if session.writes:
        from softgrasp.study.query.plots import figure_answer, figure_batch  # brings Matplotlib

        drawn += figure_batch(answers, session.out / "answers.png") if many else figure_answer(first, session.out)
    figures, notes = captioned(drawn, CAPTIONS), warnings(answers)
    if many:
        parts = [answers.parameter_table().section(figures=figures, terminal=True)]
    else:
        parts = [Section("", figures=figures)]
        parts += [Section("Answer", rows=answer_rows(first), terminal=True)] if shown else []
        parts += [error_table(first.certificate).section()]
        parts += [output_table(first).section()] if shown else []
    about = [("modes of the answer, of the proof", f"{model.k}, {model.k2}")]
    about += [("trained for", box_text(model.box))] if model.box is not None else []
    about += (
        [("built for an error of", f"{percent(model.tolerance)} of the {NORMS[model.norm]}")]
        if model.tolerance is not None
        else []
    )
    tables = {("answers.csv" if many else "answer.csv"): answers.table()} if shown else {}
    error, *summary = _summary_batch(answers) if many else _summary(first, answers.seconds)
    return Page(
        "Answer of a certified model", summary, [*parts, Section("Model", rows=about)], tables, drawn, options,
        errors=[error], warnings=notes,
    )  # fmt: skip


def warnings(answers: QueryResult) -> list[str]:
    """What a user should know of the answers, in sentences."""
    each = answers.each
    return list(dict.fromkeys(x for a in each for x in (a.certificate.reasons if answers.many else a.warnings)))


def result_of(answers: QueryResult) -> dict[str, Any]:
    """The keys of ``result.json``."""
    table = answers.parameter_table()
    return {
        "command": "query", "scene": answers.model.fine.name, "model": str(answers.path),
        "warnings": warnings(answers), "answers": [dict(zip(table.header, row, strict=True)) for row in table.rows],
        "time": {"query": answers.seconds},
    }  # fmt: skip


def box_text(box: ParameterDomain) -> str:
    """The box of the training in words."""
    return f"lambda {box.lam[0]:g} to {box.lam[1]:g} Pa, mu {box.mu[0]:g} to {box.mu[1]:g} Pa"


def error_table(c: Certificate) -> Table:
    """The three errors of an answer and what each is."""
    mesh = None if c.mesh is None else Share(c.mesh.largest)
    rows = [
        ("reduction", Share(c.reduction), c.how, f"the {c.what}"),
        ("time step", None if c.time_step is None else Share(c.time_step), "estimated", f"the {NORMS['energy']}"),
        ("mesh", mesh, "not known" if mesh is None else "estimated", "the deformation at the outputs"),
    ]
    return Table(("error of the", "at most or about", "it is", "relative to"), rows, "Errors")


def output_table(answer: CertifiedAnswer) -> Table:
    """Every output at the end, its largest deformation, and the errors of both."""
    bound = f"error {answer.certificate.how} [m]"
    header = ("output", "at the end [m]", "largest deformation [m]", bound, "error estimated [m]")
    return Table(header, answer.outputs(), "Outputs")


def _summary(answer: CertifiedAnswer, seconds: float) -> list[str]:
    c, at = answer.certificate, f"At {answer.parameters}"
    off = [] if c.time_step is None else [f"that of the time step is about {percent(c.time_step)}"]
    off += [f"that of the mesh about {percent(c.mesh.largest)} of the deformation"] if c.mesh is not None else []
    error = f"The error of the reduction {c.claim(percent(c.reduction))}"
    error += f"; {in_words(off)}, by estimates." if off else "; those of time step and mesh are not known."
    if answer.run is None:
        return [error, f"{at} the certified model refuses to answer."]
    ends = in_words([f"{name} at {end:.4g} m" for name, end, *_ in answer.outputs()])
    took = "" if answer.full else f", in {1e3 * seconds:.3g} ms with its error"
    within = (
        [] if answer.warnings or c.tolerance is None else [f"This is within the tolerance of {percent(c.tolerance)}."]
    )
    return [error, f"{at} the {answer.source} ends with {ends}{took}.", *within]


def _summary_batch(answers: QueryResult) -> list[str]:
    refused, full, outside = answers.counts
    worst = answers.each[answers.worst[0]]
    count = len(answers.each)
    others = (f"; the full model answers {full}" if full else "") + (f"; {refused} are refused" if refused else "")
    return [
        f"The largest error of the reduction {worst.certificate.claim(percent(worst.certificate.reduction))}, "
        f"at {worst.parameters}.",
        f"The reduced model answers {count - refused - full} of {count} materials, in {1e3 * answers.seconds:.3g} ms"
        f"{others}.",
        *([f"{outside} of {count} materials lie outside the box of the training."] if outside else []),
    ]
