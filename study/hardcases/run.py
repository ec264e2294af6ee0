"""``softgrasp hardcases``: cases that break the plain way, each with the bound that ours has to keep, or refuse."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.progress import MofNCompleteColumn
from rich.table import Table

from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.forward.result import package_version
from softgrasp.study.hardcases import carex as hard_carex
from softgrasp.study.hardcases import motion as hard_motion
from softgrasp.study.hardcases import numbers as hard_numbers
from softgrasp.study.hardcases import ranks as hard_rank
from softgrasp.study.hardcases import reduction as hard_reduction
from softgrasp.study.hardcases import riccati as hard_riccati
from softgrasp.study.hardcases import statics as hard_forward
from softgrasp.study.hardcases.cases import Family, Outcome, Row
from softgrasp.study.hardcases.plots import figure_family
from softgrasp.study.report.page import Section, write_report
from softgrasp.study.shell.session import list_files, machine, plain, progress_bar, write_json

MODULES: Any = (hard_forward, hard_motion, hard_reduction, hard_carex, hard_riccati, hard_numbers, hard_rank)
FAMILIES: dict[str, Family] = {family.name: family for module in MODULES for family in module.FAMILIES}
HEADER = ("case", "bound", "ours", "textbook", "verdict", "reason of the bound")
WORDS = 30  # letters of an outcome that a column of the report holds
INTRO = (
    "Every case has a fixed bound with a reason. A case passes when our number keeps the bound; a refusal, "
    "one sentence that says why, counts only where the bound allows it. Beside it stands what the plain textbook way "
    "does with the same case."
)


@dataclass(frozen=True)
class Finding:
    """A family that was run: its rows and the seconds they took."""

    family: Family
    rows: tuple[Row, ...]
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether every row keeps its promise."""
        return all(row.ok for row in self.rows)


def choose(family: str | None) -> list[Family]:
    """The families to run. Not collective.

    Raises:
        SoftgraspError: there is no family of this name.
    """
    if family is None:
        return list(FAMILIES.values())
    if family not in FAMILIES:
        raise SoftgraspError(f"'{family}' is no family of hard cases; there are {', '.join(FAMILIES)}")
    return [FAMILIES[family]]


def run_hardcases(
    out: Path,
    console: Console,
    *,
    quick: bool = False,
    family: str | None = None,
    quiet: bool = False,
    pictures: bool = True,
) -> dict[str, Any]:
    """Run the cases, print one table a family, and write result.json, hardcases.csv, pictures and report.html.

    Args:
        out: folder for the files.
        console: where the tables go.
        quick: only some cases of each family, in less than a minute.
        family: only this one.
        quiet: no progress bar.
        pictures: one a family; without them numbers and report only.

    Returns:
        What result.json holds; ``ok`` tells whether every promise is kept.

    Raises:
        SoftgraspError: the family is unknown, or the command was started under mpiexec.
    """
    if MPI.COMM_WORLD.size > 1:
        raise SoftgraspError("hardcases starts the ranks that it needs by itself; run it without mpiexec")
    families = choose(family)
    out.mkdir(parents=True, exist_ok=True)
    findings = []
    with progress_bar(console, MofNCompleteColumn(), quiet=quiet) as bar:
        task = bar.add_task("hard cases", total=len(families))
        for chosen in families:
            bar.update(task, description=chosen.title)
            begin = time.perf_counter()
            rows = tuple(chosen.rows(quick))
            findings.append(Finding(chosen, rows, time.perf_counter() - begin))
            show(console, findings[-1])
            bar.advance(task)
    result = result_of(findings, quick)
    files = write_files(out, findings, result, family, pictures)
    console.print(summary(result), soft_wrap=True)
    list_files(console, files)
    return result


def cells_of(row: Row) -> tuple[str, str, str, str, str, str]:
    """A row as text, in the order of `HEADER`."""
    given = "" if row.ours.refused else str(row.ours)
    return row.case, row.bound_text, given, str(row.plain), row.verdict_text, row.reason


def show(console: Console, finding: Finding) -> None:
    """Print the table of one family."""
    family = finding.family
    console.print(f"[bold]{family.name}[/bold]: {family.title}; {plain_label(family.quantity)}", soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for title in ("", "case", "bound", "ours", family.plain, "verdict"):
        table.add_column(title, overflow="fold")
    for row in finding.rows:
        mark = "[green]ok[/]" if row.ok else "[red]no[/]"
        table.add_row(mark, *(escape(cell) for cell in cells_of(row)[:5]))
    console.print(table)
    console.print(f"{finding.seconds:.1f} s\n")


def plain_label(text: str) -> str:
    """A label without the marks of mathematics, for terminals and files."""
    return text.replace("$", "").replace("\\nu", "nu")


def _outcome(outcome: Outcome) -> dict[str, Any]:
    return {"value": plain(outcome.value), "text": outcome.text, "refused": outcome.refused}


def result_of(findings: Sequence[Finding], quick: bool) -> dict[str, Any]:
    """What result.json holds. Not collective."""
    rows = [row for finding in findings for row in finding.rows]
    families = {
        f.family.name: {
            "title": f.family.title,
            "varied": plain_label(f.family.varied),
            "quantity": plain_label(f.family.quantity),
            "plain": f.family.plain,
            "lesson": f.family.lesson,
            "ok": f.ok,
            "seconds": f.seconds,
            "rows": [
                {
                    "case": row.case,
                    "x": plain(row.x),
                    "group": row.group,
                    "bound": plain(row.bound),
                    "must_be_refused": row.bound is None,
                    "may_be_refused": row.may_refuse,
                    "reason": row.reason,
                    "ours": _outcome(row.ours),
                    "plain": _outcome(row.plain),
                    "verdict": row.verdict_text,
                    "ok": row.ok,
                }
                for row in f.rows
            ],
        }
        for f in findings
    }
    return {
        "command": "hardcases",
        "version": package_version(),
        "machine": machine(),
        "quick": quick,
        "ok": all(f.ok for f in findings),
        "cases": len(rows),
        "passed": sum(row.verdict == "pass" for row in rows),
        "refused": sum(row.verdict == "refused" and row.ok for row in rows),
        "failed": [f"{f.family.name}: {row.case}" for f in findings for row in f.rows if not row.ok],
        "families": families,
        "time": {"total": sum(f.seconds for f in findings)},
    }


def summary(result: dict[str, Any]) -> str:
    """One sentence on the whole suite."""
    failed = result["failed"]
    text = (
        f"{result['cases']} cases: {result['passed']} keep their bound, {result['refused']} are refused as they may be"
    )
    return f"{text}, {len(failed)} fail" + (f": {'; '.join(failed)}" if failed else "")


def write_files(
    out: Path, findings: Sequence[Finding], result: dict[str, Any], family: str | None, draw: bool
) -> list[Path]:
    """Write result.json, hardcases.csv, one picture a family and report.html. Not collective."""
    pictures = {}
    for f in findings:
        if draw and f.rows:
            pictures[f.family.name] = figure_family(f.family, f.rows, out / f"hard_{f.family.name}.png")
    files = [
        write_json(out / "result.json", result),
        write_csv(out / "hardcases.csv", findings),
        *(file for pair in pictures.values() for file in pair),
    ]
    options = (" --quick" if result["quick"] else "") + (f" --family {family}" if family else "")
    page = write_report(
        out / "report.html",
        title="Hard cases",
        subtitle=summary(result),
        sections=sections(findings, {name: pair[0] for name, pair in pictures.items()}),
        reproduce=f"softgrasp hardcases{options}",
        numbers="result.json and hardcases.csv",
    )
    return [*files, page]


def write_csv(path: Path, findings: Sequence[Finding]) -> Path:
    """One line a case, numbers in full. Not collective."""
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["family", "quantity", *HEADER[:2], "ours value", "textbook value", *HEADER[2:], "ok"])
        for f in findings:
            for row in f.rows:
                cells = cells_of(row)
                head = [f.family.name, plain_label(f.family.quantity), *cells[:2], row.ours.value, row.plain.value]
                writer.writerow([*head, *cells[2:], row.ok])
    return path


def sections(findings: Sequence[Finding], pictures: dict[str, Path]) -> list[Section]:
    """The parts of the report: what came out, and one section a family. Not collective."""
    overview = []
    for f in findings:
        verdicts = [row.verdict for row in f.rows]
        failed = sum(not row.ok for row in f.rows)
        refused = sum(row.ok for row in f.rows if row.verdict == "refused")
        overview.append((f.family.title, len(f.rows), verdicts.count("pass"), refused, failed, round(f.seconds, 1)))
    parts = [
        Section("Overview", INTRO, header=("family", "cases", "pass", "refused", "fail", "seconds"), rows=overview)
    ]
    for f in findings:
        reasons = "; ".join(dict.fromkeys(row.reason for row in f.rows))
        text = f"{f.family.lesson}\n\nMeasured: {plain_label(f.family.quantity)}. Textbook way: {f.family.plain}."
        text += f" Why these bounds: {reasons}." if reasons else ""
        shown = [(pictures[f.family.name], caption(f.family))] if f.family.name in pictures else []
        rows = [brief(row) for row in f.rows]
        parts.append(Section(f.family.title, text, header=HEADER[:-1] if rows else (), rows=rows, figures=shown))
        if said := sentences(f):
            parts.append(Section("", "In their own words:", rows=said))
    return parts


def brief(row: Row) -> tuple[str, str, str, str, str]:
    """A row in few letters, for the table of the report; `sentences` has the rest."""
    case, bound, given, textbook, _, _ = cells_of(row)
    verdict = row.verdict if row.ok else "fail, refused" if row.verdict == "refused" else "fail"
    if len(textbook) > WORDS:
        textbook = f"{row.plain.value:.2g}" if row.plain.value is not None else textbook.split(":")[0].split(",")[0]
    if len(given) > WORDS:
        given = "no number" if row.ours.value is None else f"{row.ours.value:.2g}"
    return case, bound, given, textbook, verdict


def sentences(finding: Finding) -> list[tuple[str, str]]:
    """What was said at length: refusals, errors, remarks on a number; with the case and who said it."""
    found = []
    for row in finding.rows:
        if row.ours.refused or len(str(row.ours)) > WORDS:
            found.append((f"{row.case}: ours", row.ours.text))
        if len(str(row.plain)) > WORDS:
            found.append((f"{row.case}: textbook", row.plain.text))
    return found


def caption(family: Family) -> str:
    """What the picture of a family shows."""
    beside = "beside the frame" if family.axis == "listed" else "in the lanes above"
    return (
        f"{family.title}: {plain_label(family.quantity)}. Blue: ours; orange: {family.plain}; short grey lines: the "
        f"bound; marks {beside}: refused, or no number."
    )
