"""What every benchmark does alike: ranks, goals, its console, and the files at the end."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console

from softgrasp.study.report.files import write_json
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.processes import IN_MPI_JOB

Row = dict[str, Any]  # what a worker measured, as JSON has it


@dataclass(frozen=True)
class Goal:
    """A number to reach: ``value <= limit``."""

    text: str
    value: float
    limit: float

    @property
    def ok(self) -> bool:
        """Whether it is reached."""
        return self.value <= self.limit


def parse_list(text: str, pattern: str, advice: str) -> list[Any]:
    """The groups of a regular expression for each part of a list with commas. Raises typer.BadParameter: no match."""
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        if not re.fullmatch(pattern, part):
            raise typer.BadParameter(f"'{part}' is no {advice}")
    return [groups for part in parts for groups in re.findall(f"^{pattern}$", part)]


def parse_ranks(text: str) -> list[int]:
    """``1,2`` as numbers. Raises typer.BadParameter: anything else."""
    return parse_numbers(text, r"([1-9]\d*)", "number of ranks; write 1,2")


def parse_numbers(text: str, pattern: str, advice: str) -> list[int]:
    """Whole numbers, see :func:`parse_list`."""
    return [int(part) for part in parse_list(text, pattern, advice)]


def growth(n: Sequence[float], cost: Sequence[float]) -> float | None:
    """Exponent p of cost ~ n^p by least squares on logarithms; None for fewer than two positive points."""
    points = [(a, b) for a, b in zip(n, cost, strict=True) if a > 0 and b > 0]
    if len({a for a, _ in points}) < 2:
        return None
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def number(value: float | None, digits: int = 3) -> str:
    """Three digits, or all before the point; a dash for None."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 10**digits else f"{value:.{digits}g}"


def measured(rows: Sequence[Row]) -> list[Row]:
    """Rows that did not fail."""
    return [row for row in rows if "error" not in row]


def entry(row: Any, path: str) -> Any:
    """What a row has at a path of keys, "step_us.ts"; None where it has nothing."""
    for key in path.split("."):
        row = row.get(key) if isinstance(row, dict) else None
    return row


def table_of(rows: Sequence[Row], columns: Mapping[str, str], title: str = "") -> Table:
    """One line a row: for each heading the entry at a path, formatted as behind a blank it says, ``drift .0e``.

    The format 3 is that of :func:`number`; without one the entry stands as it is.
    """

    def cell(row: Row, column: str) -> Any:
        path, _, form = column.partition(" ")
        value = entry(row, path)
        if not form:
            return value
        return number(value) if form == "3" or value is None else f"{value:{form}}"

    return Table(tuple(columns), [[cell(row, column) for column in columns.values()] for row in rows], title)


Curve = tuple[str, Sequence[tuple[float, float]], dict[str, Any]]  # label, points, look


def loglog(path: Path, curves: Sequence[Curve], x: str, y: str, title: str = "") -> tuple[Path, ...]:
    """Curves that have points, the legend beside them; PNG and PDF."""
    import matplotlib.pyplot as plt

    from softgrasp.study.pictures.style import paper_style, save

    with paper_style():
        figure, axes = plt.subplots(figsize=(4.2, 3.1))
        for label, points, look in curves:
            if points:
                axes.loglog(*zip(*sorted(points), strict=True), label=label, **({"marker": "o", "ms": 4} | look))
        axes.set(xlabel=x, ylabel=y)
        axes.set_title(title, loc="left")
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.02, 0.5))
        return save(figure, path)


def open_console(width: int) -> Console:
    """A terminal wide enough for the table. Raises typer.BadParameter: the benchmark was started under mpiexec."""
    if any(variable in os.environ for variable in IN_MPI_JOB):
        raise typer.BadParameter("start the benchmark without mpiexec; it launches its own ranks")
    return Console(highlight=False, width=max(Console().width, width), soft_wrap=True)


def show_goals(console: Console, goals: Sequence[Goal]) -> None:
    """Print what was to be reached, and whether it is."""
    for goal in goals:
        verdict = "[green]ok[/green]" if goal.ok else "[red]missed[/red]"
        console.print(f"goal {verdict}: {goal.text} {number(goal.value)} <= {goal.limit:g}")


def goal_rows(goals: Sequence[Goal]) -> list[dict[str, Any]]:
    """Goals as the JSON file has them."""
    return [{"goal": g.text, "value": g.value, "limit": g.limit, "ok": g.ok} for g in goals]


def write_bench(out: Path, name: str, content: dict[str, Any], table: Table, markdown: str = "") -> list[Path]:
    """NAME.json, NAME.csv and NAME.md; returns what was written."""
    out.mkdir(parents=True, exist_ok=True)
    files = [write_json(out / f"{name}.json", content), table.write_csv(out / f"{name}.csv")]
    if markdown:
        files.append(out / f"{name}.md")
        files[-1].write_text(markdown)
    return files


def list_bench(console: Console, files: Sequence[Path], failed: bool) -> None:
    """Print the files and leave with status 1 where a row failed. Raises typer.Exit: a row failed."""
    for file in files:
        console.print(f"  {file}")
    if failed:
        raise typer.Exit(1)
