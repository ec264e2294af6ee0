"""What the suite shows: tables in a terminal, pictures, result.json, table and page of the suite."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from softgrasp.study.pictures.style import BLUE, COLUMN, ORANGE, OUTLINE, WIDTH, paper_style, save
from softgrasp.study.report import Page, Section, Table
from softgrasp.study.shell import Session
from tests.hardcases.cases import Family, FamilyResult, HardCase, HardCaseResult, Outcome, bare_label

WORDS = 30  # letters of an outcome that a column of the report holds
INTRO = (
    "Every case has a fixed bound with a reason. A case passes when the number from here keeps the bound; a refusal, "
    "one sentence that says why, counts only where the bound allows it. Beside it stands what the textbook way "
    "does with the same case."
)


def cells_of(case: HardCase) -> tuple[str, str, str, str, str]:
    """Case, bound, the two outcomes and the verdict as text."""
    return (
        case.case, case.bound_text, "" if case.ours.refused else str(case.ours), str(case.reference), case.verdict_text,
    )  # fmt: skip


def show(console: Console, result: FamilyResult) -> None:
    """Print the table of one family."""
    family = result.family
    console.print(f"[bold]{family.name}[/bold]: {family.title}; {bare_label(family.quantity)}", soft_wrap=True)
    rows = [("ok" if case.ok else "no", *cells_of(case)) for case in result.cases]
    table = Table(("", "case", "bound", "here", family.textbook, "verdict"), rows)
    console.print(table.terminal(wrap=range(1, 6), width=console.width))
    console.print(f"{result.seconds:.1f} s\n")


def compose(result: HardCaseResult, family: str | None, session: Session) -> Page:
    """Draw one picture a family, and compose the page."""
    figures = {
        f.family.name: figure_family(f.family, f.cases, session.out / f"hard_{f.family.name}.png")
        for f in result.families
        if session.pictures and any(o.value is not None for case in f.cases for o in (case.ours, case.reference))
    }
    cases = [case for f in result.families for case in f.cases]
    kept = [c for c in cases if c.reference.value is not None and (c.bound is None or c.reference.value <= c.bound)]
    return Page(
        "Hard cases",
        [
            f"{result.summary}.",
            f"The textbook way keeps the same bound in {len(kept)} of them.",
            f"All took {result.seconds:.3g} s.",
        ],
        sections(result, {name: pair[0] for name, pair in figures.items()}),
        {"hardcases.csv": csv_table(result)},
        [file for pair in figures.values() for file in pair],
        command="python -m tests.hardcases" + " --quick" * result.quick + (f" --family {family}" if family else ""),
    )


def csv_table(result: HardCaseResult) -> Table:
    """One line a case, numbers in full."""
    header = ("family", "quantity", "case", "bound", "ours value", "textbook value", "ours", "textbook", "verdict")
    rows = []
    for f in result.families:
        for case in f.cases:
            name, bound, *texts = cells_of(case)
            first = f.family.name, bare_label(f.family.quantity), name, bound
            rows.append((*first, case.ours.value, case.reference.value, *texts, case.reason, case.ok))
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
        table = Table(("case", "bound", "here", "textbook", "verdict"), [short_row(case) for case in f.cases])
        parts.append(table.section(text, family.title, figures=figures))
        texts = [line for case in f.cases for line in long_rows(case)]
        if texts:
            parts.append(Section("", "Refusals and remarks in full:", rows=texts))
    return parts


def short_row(case: HardCase) -> tuple[str, str, str, str, str]:
    """A case in few letters; `long_rows` has the rest."""
    name, bound, here, textbook, _ = cells_of(case)
    verdict = case.verdict if case.ok else "fail, refused" if case.verdict == "refused" else "fail"
    if len(textbook) > WORDS:
        value = case.reference.value
        textbook = case.reference.error or (textbook if value is None else f"{value:.2g}")
    if len(here) > WORDS:
        here = "no number" if case.ours.value is None else f"{case.ours.value:.2g}"
    return name, bound, here, textbook, verdict


def long_rows(case: HardCase) -> list[tuple[str, str]]:
    """What `short_row` has no room for: refusals, errors, remarks on a number; with the case and who said it."""
    texts = [(f"{case.case}: here", case.ours.text)] if case.ours.refused or len(str(case.ours)) > WORDS else []
    return [*texts, *([(f"{case.case}: textbook", case.reference.text)] if len(str(case.reference)) > WORDS else [])]


# --- one picture a family: the ways against the bound

SMALLEST = 1e-17  # smaller numbers, and zero, are drawn here
LARGEST = 1e12  # larger numbers are drawn as none
GAP = 0.6  # [decades] around the numbers
BESIDE = 42  # [letters] of a failure that fit beside the frame
LABEL = 34  # [letters] of a line of the name of a case
SIZE = 4.5  # of a mark


def figure_family(family: Family, rows: Sequence[HardCase], out_png: Path) -> tuple[Path, ...]:
    """Numbers against what is varied, with lanes above for refusals and for what has no number; PNG and PDF."""
    with paper_style():
        draw = _listed if family.axis == "listed" else _curves
        return save(draw(family, rows), out_png)


def _drawn(outcome: Outcome) -> float:
    """Logarithm of the value as it is drawn; NaN for one of the lanes."""
    value = outcome.value
    if outcome.refused or value is None or not math.isfinite(value) or value > LARGEST:
        return math.nan
    return _log(value)


def _log(value: float) -> float:
    return math.log10(max(value, SMALLEST))


def _range(rows: Sequence[HardCase]) -> tuple[float, float]:
    """Decades that hold all numbers and bounds."""
    values = [v for r in rows for o in (r.ours, r.reference) if math.isfinite(v := _drawn(o))]
    values += [_log(r.bound) for r in rows if r.bound is not None]
    return (min(values) - GAP, max(values) + GAP) if values else (-1.0, 1.0)


def _ticks(low: float, high: float, count: int) -> list[int]:
    """Round powers of ten between two, not more than about so many."""
    step = next(s for s in (1, 2, 3, 4, 5, 10, 20, 50, 100, 200, 500) if (high - low) / s <= count)
    return list(range(step * math.ceil(low / step), math.floor(high) + 1, step))


def _positions(family: Family, rows: Sequence[HardCase]) -> tuple[dict[float, float], list[float], list[str]]:
    """Where each varied number stands, and the ticks; zero stands apart on the left of a logarithm."""
    xs = sorted({r.x for r in rows})
    if family.axis == "linear":
        ticks = MaxNLocator(6, integer=True).tick_values(min(xs), max(xs))
        shown = [float(t) for t in ticks if 0 <= t <= 1.05 * max(xs)]
        return {x: x for x in xs}, shown, [f"{t:g}" for t in shown]
    powers = [math.log10(x) for x in xs if x > 0] or [0.0]
    apart = min(powers) - max(1.0, 0.1 * (max(powers) - min(powers)))
    at = {x: math.log10(x) if x > 0 else apart for x in xs}
    whole = _ticks(min(powers) - 0.2, max(powers) + 0.2, 8)
    ticks, names = [float(p) for p in whole], [f"$10^{{{p}}}$" for p in whole]
    return (at, [apart, *ticks], ["0", *names]) if 0.0 in at else (at, ticks, names)


def _curves(family: Family, rows: Sequence[HardCase]) -> Any:
    """Number against varied number; a curve for each group, one for the textbook way."""
    figure, ax = plt.subplots(figsize=(COLUMN + 0.9, 2.9), layout="constrained")
    low, high = _range(rows)
    lane = max(0.6, 0.11 * (high - low))
    lanes = {"no number": high + 0.55 * lane, "refused": high + 1.55 * lane}
    at, ticks, names = _positions(family, rows)
    marks: dict[str, Any] = {}
    groups = list(dict.fromkeys(r.group for r in rows))
    first = {r.x: r for r in reversed(rows)}
    ways = [("reference", family.textbook, sorted(first.values(), key=lambda r: r.x), ORANGE, "x", "-")]
    for k, group in enumerate(groups):
        own = sorted((r for r in rows if r.group == group), key=lambda r: r.x)
        name = f"here, {group}" if group else "here"
        ways.append(("ours", name, own, BLUE, "os"[k % 2], "-" if k == 0 else "--"))
    for way, name, own, colour, marker, line in ways:
        x = [at[r.x] for r in own]
        ax.plot(x, [_drawn(getattr(r, way)) for r in own], color=colour, marker=marker, ms=SIZE, lw=1.0, ls=line)
        for r in own:
            outcome: Outcome = getattr(r, way)
            if math.isnan(_drawn(outcome)):
                height = (
                    lanes["refused" if outcome.refused else "no number"]
                    + (0.12 if way == "reference" else -0.12) * lane
                )
                ax.plot(at[r.x], height, marker, color=colour, ms=SIZE)
        marks[name] = Line2D([], [], color=colour, marker=marker, ms=SIZE, lw=1.0, ls=line)
    bounds = [(at[r.x], _log(r.bound)) for r in rows if r.bound is not None]
    if bounds:
        ax.plot(*zip(*bounds, strict=True), ls="", marker="_", ms=13, mew=1.6, color=OUTLINE)
        marks["bound"] = Line2D([], [], color=OUTLINE, lw=1.6)
    powers = _ticks(low, high - 0.03 * (high - low), 7)
    ax.set_yticks([*powers, *lanes.values()], [*(f"$10^{{{p}}}$" for p in powers), *lanes.keys()])
    ax.set_ylim(low, high + 2.1 * lane)
    ax.axhline(high, color="#bbbbbb", lw=0.6)
    ax.set_xticks(ticks, names)
    span = max(at.values()) - min(at.values()) or 1.0
    ax.set_xlim(min(at.values()) - 0.06 * span, max(at.values()) + 0.06 * span)
    ax.set_xlabel(family.varied)
    ax.set_ylabel(textwrap.fill(family.quantity, LABEL))
    shown = sorted(marks, key=lambda name: (name == "bound", not name.startswith("here")))
    figure.legend(
        [marks[n] for n in shown], shown, loc="outside upper left", ncols=2, handlelength=1.6, columnspacing=1.2
    )
    return figure


def _listed(family: Family, rows: Sequence[HardCase]) -> Any:
    """One line a case; numbers to the right, on a logarithm when some of them are small."""
    figure, ax = plt.subplots(figsize=(WIDTH, 0.95 + 0.33 * len(rows)), layout="constrained")
    values = [v for r in rows for v in (r.ours.value, r.reference.value, r.bound) if v is not None and math.isfinite(v)]
    scaled = min((v for v in values if v > 0), default=1.0) < 1e-2 or max(values, default=1.0) > 1e3
    if scaled:
        low, high = _range(rows)
    else:
        low, high = -0.03 * max([*values, 1.0]), 1.03 * max([*values, 1.0])
    span = high - low
    for i, row in enumerate(rows):
        if row.bound is not None:
            at = _log(row.bound) if scaled else row.bound
            ax.plot([at, at], [i - 0.36, i + 0.36], color=OUTLINE, lw=1.6)
        for outcome, colour, marker, shift in ((row.ours, BLUE, "o", -0.2), (row.reference, ORANGE, "x", 0.2)):
            place = _drawn(outcome)
            if not scaled and math.isfinite(place):
                place = outcome.value or 0.0
            missing = math.isnan(place)
            ax.plot(high + 0.05 * span if missing else place, i + shift, marker, color=colour, ms=SIZE, clip_on=False)
            if missing:
                word = "refused" if outcome.refused else textwrap.shorten(outcome.text, BESIDE, placeholder=" ...")
                ax.text(high + 0.08 * span, i + shift, word, color=colour, fontsize=6.5, va="center")
    ax.set_yticks(range(len(rows)), [textwrap.fill(row.case, LABEL) for row in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(low, high + 0.62 * span)
    if scaled:
        powers = _ticks(low, high, 5)
        ax.set_xticks(powers, [f"$10^{{{p}}}$" for p in powers])
    else:
        ax.set_xticks([t for t in MaxNLocator(6).tick_values(0, high) if 0 <= t <= high])
    for i in np.arange(len(rows) - 1) + 0.5:
        ax.axhline(i, color="#eeeeee", lw=0.6, zorder=0)
    ax.axvline(high, color="#bbbbbb", lw=0.6)
    ax.set_xlabel(family.quantity, loc="left")
    marks = {
        "here": Line2D([], [], color=BLUE, marker="o", ms=SIZE, ls=""),
        family.textbook: Line2D([], [], color=ORANGE, marker="x", ms=SIZE, ls=""),
        "bound": Line2D([], [], color=OUTLINE, lw=1.6),
    }
    figure.legend(marks.values(), marks.keys(), loc="outside upper left", ncols=3, handlelength=1.6)
    return figure
