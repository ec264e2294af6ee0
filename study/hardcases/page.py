"""What ``softgrasp hardcases`` shows: tables, pictures and page of the suite, and tables in a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from softgrasp.study.hardcases.cases import HardCase
from softgrasp.study.hardcases.plots import figure_family
from softgrasp.study.hardcases.result import FamilyResult, HardCaseResult, bare_label
from softgrasp.study.report.files import write_json
from softgrasp.study.report.page import Section, write_report
from softgrasp.study.report.tables import Table

WORDS = 30  # letters of an outcome that a column of the report holds
INTRO = (
    "Every case has a fixed bound with a reason. A case passes when the number from here keeps the bound; a refusal, "
    "one sentence that says why, counts only where the bound allows it. Beside it stands what the textbook way "
    "does with the same case."
)


def cells_of(case: HardCase) -> tuple[str, str, str, str, str]:
    """Case, bound, the two outcomes and the verdict as text."""
    return (
        case.case, case.bound_text, "" if case.here.refused else str(case.here), str(case.textbook), case.verdict_text,
    )  # fmt: skip


def show(console: Console, result: FamilyResult) -> None:
    """Print the table of one family."""
    family = result.family
    console.print(f"[bold]{family.name}[/bold]: {family.title}; {bare_label(family.quantity)}", soft_wrap=True)
    rows = [("ok" if case.ok else "no", *cells_of(case)) for case in result.cases]
    table = Table(("", "case", "bound", "here", family.textbook, "verdict"), rows)
    console.print(table.terminal(wrap=range(1, 6), width=console.width))
    console.print(f"{result.seconds:.1f} s\n")


def write_files(out: Path, result: HardCaseResult, family: str | None, pictures: bool) -> list[Path]:
    """Write result.json, hardcases.csv, one picture a family and report.html."""
    figures = {
        f.family.name: figure_family(f.family, f.cases, out / f"hard_{f.family.name}.png")
        for f in result.families
        if pictures and f.cases
    }
    options = (" --quick" if result.quick else "") + (f" --family {family}" if family else "")
    files = [write_json(out / "result.json", result.to_dict()), csv_table(result).write_csv(out / "hardcases.csv")]
    files += [file for pair in figures.values() for file in pair]
    cases = [case for f in result.families for case in f.cases]
    kept = [c for c in cases if c.textbook.value is not None and (c.bound is None or c.textbook.value <= c.bound)]
    page = write_report(
        out / "report.html",
        title="Hard cases",
        summary=[
            f"{result.summary}.",
            f"The textbook way keeps the same bound in {len(kept)} of them.",
            f"All took {result.seconds:.3g} s.",
        ],
        sections=sections(result, {name: pair[0] for name, pair in figures.items()}),
        reproduce=f"softgrasp hardcases{options}",
        numbers="result.json and hardcases.csv",
        files=files,
    )
    return [*files, page]


def csv_table(result: HardCaseResult) -> Table:
    """One line a case, numbers in full."""
    header = ("family", "quantity", "case", "bound", "ours value", "textbook value", "ours", "textbook", "verdict")
    rows = []
    for f in result.families:
        for case in f.cases:
            name, bound, *texts = cells_of(case)
            first = f.family.name, bare_label(f.family.quantity), name, bound
            rows.append((*first, case.here.value, case.textbook.value, *texts, case.reason, case.ok))
    return Table((*header, "reason of the bound", "ok"), rows)


def sections(result: HardCaseResult, pictures: Mapping[str, Path]) -> list[Section]:
    """An overview, and one section a family with what was said at length below it."""
    overview = [(f.family.title, *f.counts.values(), len(f.failed), round(f.seconds, 1)) for f in result.families]
    header = ("family", "cases", "pass", "refused", "fail", "seconds")
    parts = [Table(header, overview, "Overview").section(INTRO)]
    for f in result.families:
        family, reasons = f.family, "; ".join(dict.fromkeys(case.reason for case in f.cases))
        text = f"{family.lesson}\n\nMeasured: {bare_label(family.quantity)}. Textbook way: {family.textbook}."
        text += f" Why these bounds: {reasons}." if reasons else ""
        beside = "beside the frame" if family.axis == "listed" else "in the lanes above"
        caption = (
            f"{family.title}: {bare_label(family.quantity)}. Blue: here; orange: {family.textbook}; short grey lines: "
            f"the bound; marks {beside}: refused, or no number."
        )
        figures = [(pictures[family.name], caption)] if family.name in pictures else []
        table = Table(("case", "bound", "here", "textbook", "verdict"), [brief(case) for case in f.cases])
        parts.append(table.section(text, family.title, figures))
        texts = [line for case in f.cases for line in at_length(case)]
        if texts:
            parts.append(Section("", "Refusals and remarks in full:", rows=texts))
    return parts


def brief(case: HardCase) -> tuple[str, str, str, str, str]:
    """A case in few letters; `at_length` has the rest."""
    name, bound, here, textbook, _ = cells_of(case)
    verdict = case.verdict if case.ok else "fail, refused" if case.verdict == "refused" else "fail"
    if len(textbook) > WORDS:
        value = case.textbook.value
        textbook = case.textbook.error or (textbook if value is None else f"{value:.2g}")
    if len(here) > WORDS:
        here = "no number" if case.here.value is None else f"{case.here.value:.2g}"
    return name, bound, here, textbook, verdict


def at_length(case: HardCase) -> list[tuple[str, str]]:
    """What `brief` has no room for: refusals, errors, remarks on a number; with the case and who said it."""
    texts = [(f"{case.case}: here", case.here.text)] if case.here.refused or len(str(case.here)) > WORDS else []
    return [*texts, *([(f"{case.case}: textbook", case.textbook.text)] if len(str(case.textbook)) > WORDS else [])]
