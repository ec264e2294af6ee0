"""What every benchmark does alike: options, rows measured by workers, goals, tables, and the files at the end."""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import TypeAdapter
from rich.console import Console

from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.report.document import Columns as Columns
from softgrasp.study.report.document import Table, number
from softgrasp.study.report.document import table_of as table_of
from softgrasp.study.report.files import write_json
from softgrasp.study.shell.processes import in_mpi_job, run_ranks

Row = dict[str, Any]
LIMIT = 3600.0  # [s] of a worker
Ranks = Annotated[str, typer.Option(help="MPI rank counts; no more than there are cores")]
Repeats = Annotated[int, typer.Option(help="repeats behind each median", min=1)]


@dataclass(frozen=True)
class Failure:
    """A row without numbers."""

    label: str  # name of the measurement
    ranks: int  # number of ranks
    error: str  # why there is nothing


def launch_worker(name: str, spec: Row, ranks: int) -> Row:
    """Run ``python -m benchmarks worker NAME SPEC``, so that no row inherits memory or caches from another.

    ``spec``: arguments of the function that measures, fit for JSON. Returns the ``points`` measured until the end, or
    until the ``error`` that came before it.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.jsonl"
        text, error = json.dumps(spec | {"file": str(file)}), {}
        try:
            status, output = run_ranks(["-m", "benchmarks", "worker", name, text], ranks, LIMIT)
        except SoftgraspError as missing:
            error = {"error": str(missing)}
        else:
            if status is None:
                error = {"error": f"no result after {LIMIT:g} s"}
            elif status:
                lines = output.strip().splitlines() or ["no output"]
                last = next((line for line in lines if "Error: " in line and not line.startswith(" ")), lines[-1])
                error = {"error": f"exit status {status}: {last}"}
        lines = file.read_text().splitlines() if file.is_file() else []
    return {"points": [json.loads(line) for line in lines], **error}


def measure[P](console: Console, kind: type[P], name: str, spec: Row, ranks: int, label: str) -> list[P | Failure]:
    """The points of one worker, and the reason where it failed."""
    with console.status(f"{label}, {ranks} rank(s)"):
        result = launch_worker(name, spec, ranks)
    points = TypeAdapter(list[kind | Failure]).validate_python(result["points"])  # type: ignore[valid-type]
    return [*points, *([Failure(label, ranks, result["error"])] if "error" in result else [])]


def failures(rows: Sequence[Any]) -> list[Failure]:
    """Rows without numbers."""
    return [row for row in rows if isinstance(row, Failure)]


def of[P](kind: type[P], rows: Sequence[Any]) -> list[P]:
    """Rows that were measured."""
    return [row for row in rows if isinstance(row, kind)]


@dataclass(frozen=True)
class Goal:
    """A number to reach: ``value <= limit``."""

    text: str  # meaning of the number
    value: float  # measured number
    limit: float  # largest number that reaches the goal

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


def parse_numbers(text: str, pattern: str, advice: str) -> list[int]:
    """Whole numbers, see :func:`parse_list`."""
    return [int(part) for part in parse_list(text, pattern, advice)]


def parse_ranks(text: str) -> list[int]:
    """``1,2`` as numbers. Raises typer.BadParameter: anything else."""
    return parse_numbers(text, r"([1-9]\d*)", "number of ranks; write 1,2")


def cpu_seconds(call: Callable[[], object]) -> float:
    """Processor time of a call [s]."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


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
    if in_mpi_job():
        raise typer.BadParameter("start the benchmark without mpiexec; it launches its own ranks")
    return Console(highlight=False, width=max(Console().width, width), soft_wrap=True)


def measure_each[P](console: Console, names: Sequence[str], call: Callable[[str], P]) -> list[P]:
    """A row for each name, which the terminal shows meanwhile."""
    rows = []
    for name in names:
        with console.status(name):
            rows.append(call(name))
    return rows


def show_goals(console: Console, goals: Sequence[Goal]) -> None:
    """Print what was to be reached, and whether it is."""
    for goal in goals:
        verdict = "[green]ok[/green]" if goal.ok else "[red]missed[/red]"
        console.print(f"goal {verdict}: {goal.text} {number(goal.value)} <= {goal.limit:g}")


def goal_rows(goals: Sequence[Goal]) -> list[Row]:
    """Goals as the JSON file has them."""
    return [{"goal": g.text, "value": g.value, "limit": g.limit, "ok": g.ok} for g in goals]


def write_bench(out: Path, name: str, content: Row, table: Table, markdown: str = "") -> list[Path]:
    """NAME.json, NAME.csv and NAME.md; returns what was written."""
    out.mkdir(parents=True, exist_ok=True)
    files = [write_json(out / f"{name}.json", content), table.write_csv(out / f"{name}.csv")]
    if markdown:
        files.append(out / f"{name}.md")
        files[-1].write_text(markdown)
    return files


def finish(console: Console, out: Path, name: str, rows: Sequence[Any], table: Table, goals: Sequence[Goal]) -> None:
    """Print table and goals, and write NAME.json, NAME.csv and NAME.md of rows that are dataclasses."""
    console.print(table.terminal())
    show_goals(console, goals)
    content = {"command": name, "rows": list(map(asdict, rows)), "goals": goal_rows(goals)}
    list_bench(console, write_bench(out, name, content, table, table.markdown()))


def list_bench(console: Console, files: Sequence[Path], failed: Sequence[Failure] = ()) -> None:
    """Print the files and what failed. Raises typer.Exit: a row failed, the status is 1."""
    for row in failed:
        console.print(f"{row.label}, {row.ranks} rank(s) failed: {row.error}", markup=False)
    for file in files:
        console.print(f"  {file}")
    if failed:
        raise typer.Exit(1)
