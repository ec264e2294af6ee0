"""The ten most prominent figures of README and pages: the command that prints each, and its spread over some runs."""

from __future__ import annotations

import json
import resource
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from benchmarks import driver
from benchmarks.driver import Row
from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.report.document import Table

LIMIT = 1800.0  # [s] of one run of a command
NAME = "bench_figures"
HELP = """Run the commands behind the ten most prominent figures of README and pages, several times, and print them.

A command runs as a user types it, in a process of its own; its figures are read from the files that it writes.
Speed-ups and times are of the processor, so that other work on the machine hardly changes them. Commands that
bench_figures.json in --out has often enough are not run again, unless --only names them."""


def at(path: str, times: float = 1.0) -> Callable[[Row], float]:
    """The number at a path of keys with dots, and of indices, in another unit."""

    def read(result: Row) -> float:
        value = result
        for key in path.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        return times * float(value)  # type: ignore[arg-type]

    return read


def craig_bampton(key: str) -> Callable[[Row], float]:
    """An error of Craig-Bampton at N = 14 from the table of errors over the box [%]."""

    def read(result: Row) -> float:
        (row,) = (r for r in result["box"]["summary"] if (r["method"], r["N"]) == ("craig_bampton", 14))
        return 100 * float(row[key])

    return read


@dataclass(frozen=True)
class Number:
    """One number of a figure."""

    text: str  # meaning, with its unit
    read: Callable[[Row], float]  # function from the results of a command to the number


@dataclass(frozen=True)
class Figure:
    """A figure of one or two numbers."""

    text: str  # meaning of the numbers, with {} for each
    numbers: tuple[Number, ...]  # numbers in the order of the text


@dataclass(frozen=True)
class Command:
    """A command and the figures that it prints."""

    name: str  # argument of --only
    line: str  # command line without --out
    figures: tuple[Figure, ...]  # figures read from its results
    file: str = "result.json"  # file of the numbers, relative to the folder of results

    def arguments(self, out: Path) -> list[str]:
        """For a process of this Python."""
        program, *words = shlex.split(self.line)
        head = ["-c", "from softgrasp.study.cli import main; main()"] if program == "softgrasp" else []
        return [sys.executable, *head, *words, "--out", str(out)]


def speed(text: str) -> Figure:
    """The headline of ``reduce``: full and reduced run in turn, by processor time."""
    again, new = Number("again", at("headline.again.median")), Number("new", at("headline.new.median"))
    return Figure(f"{text}: speed-up again and at a new material", (again, new))


BASIS = "Craig-Bampton, N = 14"
ADAPTED = "softgrasp simulate paper_forward -s tissue.order=2 -s tissue.refine.tolerance=1e-2 --no-pictures"
STRAIN = "softgrasp reduce paper_forward -s effects.finite_strain={} -s reduction.N=[14,24] --no-pictures"
COMMANDS = (
    Command("mesh", "softgrasp simulate paper_forward --no-pictures", (
        Figure("the paper's own mesh: error of the deformation, estimate",
               (Number("%", at("mesh_error.estimate", 100)),)),
    )),
    Command("adapted", ADAPTED, (
        Figure("a mesh to 1e-2: error, estimate and bound",
               (Number("%", at("mesh_error.estimate", 100)), Number("bound, %", at("mesh_error.bound", 100)))),
        Figure("the same: processor time of the whole command", (Number("s", at("time.total_cpu")),)),
    )),
    Command("reduce", "softgrasp reduce paper_forward --no-pictures", (
        Figure(f"{BASIS}: error at the scene's material", (Number("%", craig_bampton("own")),)),
        Figure(f"{BASIS}: error at new materials",
               (Number("median, %", craig_bampton("median")), Number("most, %", craig_bampton("largest")))),
        speed(BASIS),
    )),
    Command("strain", STRAIN, (
        Figure("finite strain: error of linear elasticity, and of a reduced model of N = 24",
               (Number("linear, %", at("error_linear", 100)),
                Number("reduced, %", at("finite_strain.own.points.1.error_own", 100)))),
        speed("finite strain, N = 24"),
    )),
    Command("query", "python -m benchmarks outputs --scenes paper --materials 20", (
        Figure("a certified answer and a full run, processor time",
               (Number("answer, ms", at("rows.0.answer_ms")), Number("full run, ms", at("rows.0.full_ms")))),
    ), "bench_outputs.json"),
    Command("gain", "softgrasp control paper_lqr --gain-only --no-pictures", (
        Figure("Riccati equation of 880 states, checks and controller: processor time of the whole command",
               (Number("s", at("time.total_cpu")),)),
    )),
)  # fmt: skip


def run_once(command: Command) -> tuple[Row, float]:
    """What one run of a command wrote, and its processor time [s].

    Raises SoftgraspError: it failed or did not end in time.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, before = Path(folder) / "out", resource.getrusage(resource.RUSAGE_CHILDREN)
        try:
            done = subprocess.run(command.arguments(out), capture_output=True, text=True, timeout=LIMIT, check=False)
        except subprocess.TimeoutExpired as error:
            raise SoftgraspError(f"{command.line}: no end after {LIMIT:g} s") from error
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["it printed nothing"]
            raise SoftgraspError(f"{command.line}: status {done.returncode}: {said[0]}")
        result = json.loads((out / command.file).read_text())
    return result, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def numbers(command: Command, repeats: int, console: Console) -> Row:
    """Numbers of all runs of a command, one list a number, and its processor times."""
    rows: list[list[float]] = []
    seconds: list[float] = []
    for i in range(repeats):
        with console.status(f"{command.name}: run {i + 1} of {repeats}"):
            result, cpu = run_once(command)
        rows.append([n.read(result) for figure in command.figures for n in figure.numbers])
        seconds.append(cpu)
    return {"line": command.line, "values": [list(column) for column in zip(*rows, strict=True)], "cpu": seconds}


def short(value: float) -> str:
    """Three digits."""
    return f"{value:#.3g}".rstrip(".")


def table_of(found: Row) -> Table:
    """One line a figure: its meaning, median, least and most of each of its numbers, command."""
    lines: list[list[str]] = []
    for command in COMMANDS:
        if command.name not in found:
            continue
        columns, place = found[command.name]["values"], 0
        for figure in command.figures:
            own = columns[place : place + len(figure.numbers)]
            place += len(own)
            medians = [f"{short(float(np.median(x)))} ({n.text})" for n, x in zip(figure.numbers, own, strict=True)]
            spread = [f"{short(min(x))} to {short(max(x))}" for x in own]
            runs = str(len(own[0]))
            lines.append([figure.text, ", ".join(medians), ", ".join(spread), runs, f"`{command.line}`"])
    return Table(("figure", "median", "least to most", "runs", "command"), lines, "")


def main(
    only: Annotated[str, typer.Option(help=f"of {', '.join(c.name for c in COMMANDS)}, with commas; run anew")] = "",
    repeats: Annotated[int, typer.Option(help="runs of each command", min=1)] = 5,
    out: Annotated[Path, typer.Option(help=f"folder for {NAME}.json, {NAME}.csv and {NAME}.md")] = Path("out"),
) -> None:
    """See HELP."""
    known = {command.name: command for command in COMMANDS}
    chosen = (
        driver.parse_list(only, f"({'|'.join(known)})", f"command here; there are {', '.join(known)}") if only else []
    )
    console, file = driver.open_console(160), out / f"{NAME}.json"
    found: Row = json.loads(file.read_text())["commands"] if file.is_file() else {}
    for name, command in known.items():
        kept = found.get(name, {})
        enough = kept.get("line") == command.line and len(kept.get("cpu", ())) >= repeats
        if name in chosen or not (chosen or enough):
            found[name] = numbers(command, repeats, console)
        if name in found:
            for figure, median, spread, *_ in table_of({name: found[name]}).rows:
                console.print(f"{figure}: {median}; {spread}", markup=False)
        table = table_of(found)
        content = {"command": NAME, "commands": found}
        files = driver.write_bench(out, NAME, content, table, table.markdown())  # after each, so that it can go on
    driver.list_bench(console, files)
