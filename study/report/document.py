"""A document once, for the terminal, the page, CSV and Markdown: sections and tables."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rich.box
import rich.table
from rich.console import Console
from rich.markup import escape

from softgrasp.fem import counted, digits, note, percent
from softgrasp.study.report.equation import Equation

Columns = Mapping[str, str | Callable[[Any], Any]]
"""Of each heading, what a row has there: a path of attributes, or a function of the row."""
NUMBERS = (int, float, np.integer, np.floating)
SHOWN, MOST_ROWS = 8, 14  # rows of a longer table that stand unfolded


class Share(float):
    """A number that page and terminal show as a percentage, and a CSV file in full."""

    digits = 2


class FineShare(Share):
    """One of three digits, for numbers near a bound."""

    digits = 3


@dataclass(frozen=True)
class Section:
    """One part of a page; whatever is given is shown in the order of the attributes."""

    title: str  # heading; empty for none
    text: str = ""  # paragraphs, parted by empty lines
    code: str = ""  # text shown as it is
    equation: Equation | None = None  # shown on the page in place of the code
    header: Sequence[str] = ()  # names of the columns; without it two columns are label and value
    rows: Sequence[Sequence[Any]] = ()  # a table; every row as long as the header. Numbers are shown with four digits.
    figures: Sequence[tuple[Path, str]] = ()  # (picture file, caption); the files are embedded
    terminal: bool = False  # a terminal shows texts and table too
    # rows of a long table that stand unfolded; the first ones if there are none, and no row of any table for None
    best: Sequence[int] | None = ()
    details: str = ""  # further paragraphs, folded on the page

    @property
    def unfolded(self) -> Sequence[Sequence[Any]]:
        """Rows that stand unfolded on the page, and alone in a terminal."""
        if self.best is None:
            return ()
        if not self.header or len(self.rows) <= MOST_ROWS:
            return self.rows
        return [self.rows[i] for i in self.best or range(SHOWN)]


@dataclass(frozen=True)
class Table:
    """Columns with their rows."""

    header: tuple[str, ...]  # names of the columns, units in brackets: "step [s]"
    # cells, as many in each row as there are columns; None is an empty cell. Numbers are shown with four digits and
    # written in full.
    rows: Sequence[Sequence[Any]]
    title: str = ""  # heading
    # rows that stand unfolded on a page where the table is long; the first ones if there are none
    best: Sequence[int] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"the table {self.title!r} has {len(self.header)} columns, but a row has {len(row)}")

    def write_csv(self, path: Path) -> Path:
        """One line a row, numbers in full, nothing for None. Not collective: call on one rank."""
        note(path)
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(self.header)
            writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return path

    def section(self, text: str = "", title: str | None = None, **more: Any) -> Section:
        """The table as a part of a page; ``more`` of its attributes."""
        title = self.title if title is None else title
        return Section(title, text, header=self.header, rows=self.rows, **{"best": self.best, **more})

    def markdown(self) -> str:
        """The table as a README shows it."""
        lines = [self.header, ["---"] * len(self.header), *([cell_text(cell) for cell in row] for row in self.rows)]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"

    def terminal(self, *, wrap: Sequence[int] = (), width: int = 80) -> rich.table.Table:
        """The table for a terminal of some width: numbers to the right; ``wrap``: columns that may break, in order."""
        table = rich.table.Table(box=None, padding=(0, 1, 0, 0), title=self.title or None, title_justify="left")
        columns = [[name, *(cell_text(row[i]) for row in self.rows)] for i, name in enumerate(self.header)]
        widths = [max(map(len, cells)) for cells in columns]
        for i in wrap:
            words = [word for cell in columns[i] for word in cell.split()]
            excess = sum(widths) + len(widths) - width
            widths[i] -= max(0, min(excess, widths[i] - max(map(len, words))))
        for i, name in enumerate(self.header):
            right = bool(self.rows) and all(numeric(row[i]) for row in self.rows)
            fixed = widths[i] if i in wrap else None
            table.add_column(escape(name), justify="right" if right else "left", no_wrap=i not in wrap, width=fixed)
        for row in self.rows:
            table.add_row(*(escape(cell_text(cell)) for cell in row))
        return table


@dataclass(frozen=True)
class Page:
    """One document: what a command prints, and writes beside result.json."""

    title: str  # title of the page
    summary: Sequence[str]  # three sentences that say what came out
    sections: Sequence[Section] = ()  # sections in their order
    tables: Mapping[str, Table] = field(default_factory=dict)  # by the name of its CSV file
    files: Sequence[Path] = ()  # written already: pictures and fields
    options: str = ""  # of the command line, for the page's last line: " --tolerance 1e-2"
    errors: Sequence[str] = ()  # sentences on the error of the result; coloured, above the summary
    warnings: Sequence[str] = ()  # sentences that a reader must not miss; coloured, below the errors
    subtitle: str = ""  # below the title; the description of the scene if there is none
    command: str = ""  # the line that makes the page again; that of the session if there is none
    numbers: str = ""  # the files that hold its numbers; result.json and the tables if there are none


def captioned(files: Sequence[Path], captions: Mapping[str, str]) -> list[tuple[Path, str]]:
    """The pictures among some files with their captions, in the order of the captions."""
    drawn = {file.name: file for file in files}
    return [(drawn[name], text) for name, text in captions.items() if name in drawn]


def cell_text(cell: Any) -> str:
    """Text of a cell: numbers with four digits, counts in full, nothing for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool | np.bool_):
        return "yes" if cell else "no"
    if isinstance(cell, Share):
        return percent(cell, digits=cell.digits)
    return digits(float(cell)) if isinstance(cell, float | np.floating) else str(cell)


def seconds_text(value: float | None) -> str:
    """A time with a fitting unit."""
    if value is None:
        return "-"
    for unit, factor in (("s", 1.0), ("ms", 1e-3)):
        if value >= 0.9995 * factor:
            return f"{value / factor:.3g} {unit}"
    return f"{value / 1e-6:.3g} us"


def number(value: float | None) -> str:
    """Three digits, or all before the point; a dash for None."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def entry(row: Any, path: str) -> Any:
    """What a row has at a path of attributes or keys, "step_us.ts"; None where it has nothing."""
    for key in path.split("."):
        row = row.get(key) if isinstance(row, dict) else getattr(row, key, None)
    return row


def table_of(rows: Sequence[Any], columns: Columns, title: str = "") -> Table:
    """One line a row: for each heading a function of the row, or the entry at a path, formatted ``drift .0e``.

    The format 3 is that of :func:`number`, % a :class:`Share`, %3 a finer one; without one the entry stands as it is.
    """

    def cell(row: Any, column: str | Callable[[Any], Any]) -> Any:
        if not isinstance(column, str):
            return column(row)
        path, _, form = column.partition(" ")
        value = entry(row, path)
        if not form or value is None:
            return value if not form else number(None)
        if form in ("%", "%3"):
            return Share(value) if form == "%" else FineShare(value)
        return number(value) if form == "3" else f"{value:{form}}"

    return Table(tuple(columns), [[cell(row, column) for column in columns.values()] for row in rows], title)


def show_sections(console: Console, sections: Sequence[Section]) -> None:
    """The parts of a page that a terminal shows too: title, table, whose cells may break, and texts."""
    shown = [s for s in sections if s.terminal]
    for part in shown:
        if part.title and len(shown) > 1:
            console.print(f"\n{part.title}", style="bold", markup=False)
        if part.header:
            _show_table(console, part)
        elif part.rows:
            console.print(pairs(part.rows))
        for text, style in ((part.text, None), (part.details, "dim"), (part.code, None)):
            if text:
                console.print(text, style=style, markup=False, highlight=False)


def _show_table(console: Console, part: Section) -> None:
    """The unfolded rows, of as many columns as the terminal is wide, and how many are left out."""
    header, rows = [*part.header], [[*row] for row in part.unfolded]
    words = [[word for row in (header, *rows) for word in cell_text(row[i]).split()] for i in range(len(header))]
    ends = np.cumsum([1 + max(map(len, column), default=0) for column in words])
    fitting = max(2, int(np.searchsorted(ends, console.width, side="right")))
    cut = Table(tuple(header[:fitting]), [row[:fitting] for row in rows])
    table = cut.terminal(wrap=range(len(cut.header)), width=console.width)
    table.collapse_padding = True
    console.print(table)
    left = {"row": len(part.rows) - len(rows), "column": len(header) - len(cut.header)}
    if any(left.values()):
        more = in_words([counted(count, f"more {what}") for what, count in left.items() if count])
        console.print(f"... and {more}", style="dim")


def in_words(names: Sequence[str]) -> str:
    """Names as one reads them: a, b and c."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]])) or "none"


def pairs(rows: Sequence[Sequence[str]]) -> rich.table.Table:
    """Labels and texts for a terminal."""
    table = rich.table.Table(box=None, show_header=False, pad_edge=False)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def numeric(cell: Any) -> bool:
    """A number, the text of one with its unit, or an empty cell."""
    if cell is None or cell in ("", "-") or (isinstance(cell, NUMBERS) and not isinstance(cell, bool)):
        return True
    return re.fullmatch(r"[<>~]? ?[-+]?[\d.]+(e[-+]?\d+)?( ?%| [a-zA-Zµ/]{1,4})?( ?!)?", str(cell)) is not None
