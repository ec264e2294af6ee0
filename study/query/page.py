"""The page of ``softgrasp query``: the answer, its three errors, and what a reader should be warned of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.reduction.certified.certificate import Certificate
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.study.forward.accuracy import percent
from softgrasp.study.query.answer import Answer, batch_table, parameters, trajectory_table
from softgrasp.study.report.files import to_json, write_json
from softgrasp.study.report.page import Section, write_report
from softgrasp.study.report.tables import Table, listed

CAPTIONS = {
    "answer.png": "Outputs against the hand with the band that the error bound leaves (often thinner than the line); "
    "largest error of the outputs so far, proved and estimated; the three errors beside the tolerance.",
    "errors.png": "The three errors of the reduced model beside the tolerance.",
    "answers.png": "Error of every answer against its material; crosses: refused. Frame: the box of the training.",
}


def write_page(
    out: Path, path: Path, model: CertifiedModel, answers: Sequence[Answer], seconds: float, line: str, many: bool,
) -> list[Path]:  # fmt: skip
    """Write result.json, the table, a figure and report.html. Not collective: call on one rank.

    Args:
        out: folder of the results.
        path, model: the certified model and its file.
        answers: one, or those of a batch.
        seconds: time of the reduced answers.
        line: the command line.
        many: the answers are those of a batch.
    """
    name, outputs = model.fine.name, model.fine.outputs
    out.mkdir(parents=True, exist_ok=True)
    table = batch_table(answers, outputs.names, outputs.C_s)
    warnings = list(dict.fromkeys(text for a in answers for text in (a.certificate.reasons if many else a.warnings)))
    result: dict[str, Any] = {"command": "query", "scene": name, "model": str(path), "warnings": warnings}
    result |= {"answers": [dict(zip(table.header, row, strict=True)) for row in table.rows], "time": {"query": seconds}}
    files = [write_json(out / "result.json", to_json(result))]
    if many:
        table = Table(table.header, table.rows, "Answers", best=_worst(answers))
        files.append(table.write_csv(out / "answers.csv"))
    elif answers[0].run is not None:
        files.append(trajectory_table(answers[0], model.norms.dimension).write_csv(out / "answer.csv"))
    from softgrasp.study.query.plots import figure_answer, figure_batch  # brings Matplotlib

    drawn = figure_batch(model, answers, out / "answers.png") if many else figure_answer(model, answers[0], out)
    files += drawn
    figures = [(file, CAPTIONS[file.name]) for file in drawn if file.name in CAPTIONS]
    sections = [table.section(figures=figures)] if many else [
        error_table(answers[0].certificate).section(figures=figures),
        *([output_table(model, answers[0]).section()] if answers[0].run is not None else []),
    ]  # fmt: skip
    if warnings:
        sections.insert(1, Section("Warnings", text="\n\n".join(warnings)))
    box, limit = model.box, model.tolerance
    about = [("modes of the answer, of the proof", f"{model.k}, {model.k2}")]
    if box is not None:
        about.append(
            ("trained for", f"lambda {box.lam[0]:g} to {box.lam[1]:g} Pa, mu {box.mu[0]:g} to {box.mu[1]:g} Pa")
        )
    if limit is not None:
        about.append(("built for an error of", f"{limit:g}"))
    files.append(
        write_report(
            out / "report.html", title="Answer of a certified model", subtitle=str(path),
            summary=_summary_batch(answers, seconds) if many else _summary(answers[0], outputs.names, seconds),
            sections=[*sections, Section("Model", rows=about)], result=result, reproduce=line, files=files,
        )
    )  # fmt: skip
    return files


def error_table(c: Certificate) -> Table:
    """The three errors of an answer and what each is."""
    mesh = c.mesh.largest if c.mesh is not None else None
    rows = [
        ("reduction", c.reduction, c.how, f"the {c.what}"),
        ("time step", c.time_step, "estimated", "the largest energy norm"),
        ("mesh", mesh, "estimated" if mesh is not None else "not known", "the deformation at the outputs"),
    ]
    return Table(("error of the", "at most or about", "it is", "relative to"), rows, "Errors")


def output_table(model: CertifiedModel, answer: Answer) -> Table:
    """Every output at the end, its largest deformation, and how far both can be off."""
    run, c = answer.run, answer.certificate
    assert run is not None
    most = abs(answer.deformation(model.fine.outputs.C_s)).max(axis=0)
    estimate = None if c.outputs_estimate is None else c.outputs_estimate.largest
    rows = [
        (
            name, float(run.outputs[-1, i]), float(most[i]), None if answer.full else float(c.outputs.largest[i]),
            None if answer.full or estimate is None else float(estimate[i]),
        )
        for i, name in enumerate(run.output_names)
    ]  # fmt: skip
    header = ("output", "at the end [m]", "largest deformation [m]", f"error {c.how} [m]", "error estimated [m]")
    return Table(header, rows, "Outputs")


def _summary(answer: Answer, names: Sequence[str], seconds: float) -> list[str]:
    c, at = answer.certificate, f"At {parameters(answer.materials)}"
    off = [] if c.time_step is None else [f"that of the time step is about {percent(c.time_step)}"]
    off += [f"that of the mesh about {percent(c.mesh.largest)} of the deformation"] if c.mesh is not None else []
    error = f"The error of the reduction {c.claim(percent(c.reduction))}"
    error += f"; {listed(off)}, by estimates." if off else "; those of time step and mesh are not known."
    if answer.run is None:
        return [f"{at} the certified model refuses to answer.", error, answer.refusal]
    ends = listed([f"{name} at {value:.4g} m" for name, value in zip(names, answer.run.outputs[-1], strict=True)])
    who = "full" if isinstance(answer.run, Trajectory) else "reduced"
    took = "" if answer.full else f", in {1e3 * seconds:.3g} ms with its error"
    last = answer.warnings[:1] or [f"This is within the tolerance {c.tolerance:g}."] * (c.tolerance is not None)
    return [f"{at} the {who} model ends with {ends}{took}.", error, *last]


def _summary_batch(answers: Sequence[Answer], seconds: float) -> list[str]:
    refused, full = sum(a.run is None for a in answers), sum(a.full for a in answers)
    worst = answers[_worst(answers)[0]]
    c, outside = worst.certificate, sum(not a.certificate.inside for a in answers)
    return [
        f"The reduced model answers {len(answers) - refused - full} of {len(answers)} materials, in "
        f"{1e3 * seconds:.3g} ms; the full model answers {full}, {refused} are refused.",
        f"The largest error of the reduction {c.claim(percent(c.reduction))}, at {parameters(worst.materials)}.",
        f"Outside the box of the training: {outside}; the bound holds there too.",
    ]  # fmt: skip


def _worst(answers: Sequence[Answer]) -> list[int]:
    """The answers with the largest errors, eight at most."""
    return sorted(range(len(answers)), key=lambda i: -answers[i].certificate.reduction)[:8]
