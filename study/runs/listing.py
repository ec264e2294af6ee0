"""``softgrasp list`` and ``softgrasp compare``: what lies in folders of runs, and how two of them differ."""

from __future__ import annotations

import csv
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.check import counted
from softgrasp.study.report.files import write_json
from softgrasp.study.report.origin import command_line
from softgrasp.study.report.page import Section, write_report
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.folder import claim, folder_lock, read_result
from softgrasp.study.shell.session import list_files

SHOWN = 30  # rows of numbers in a terminal; the CSV has all
ALIKE = 1e-12  # relative difference below which two numbers count as equal: rounding
LONGEST = 6  # entries of a list that is compared entry by entry


def runs_below(folder: Path) -> Table:
    """One row a run, the newest last. Raises SceneError: the folder does not exist."""
    if not folder.is_dir():
        raise SceneError(f"{folder}: there is no such folder; runs write into out/SCENE-COMMAND or where --out says")
    files = sorted(folder.rglob("result.json"), key=lambda file: file.stat().st_mtime)
    header = ("folder", "command", "scene", "n_e", "total [s]", "warnings", "ended")
    rows = [
        (
            str(file.parent), r["command"], r.get("scene", ""), r.get("n_e"), r.get("time", {}).get("total"),
            len(r.get("warnings", ())), time.strftime("%Y-%m-%d %H:%M", time.localtime(file.stat().st_mtime)),
        )
        for file in files
        if (r := read_result(file.parent))
    ]  # fmt: skip
    return Table(header, rows)


def flat(data: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables; short lists entry by entry."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield from flat(value, f"{at}.{key}" if at else str(key))
    elif isinstance(data, list) and 0 < len(data) <= LONGEST and not isinstance(data[0], str):
        for i, value in enumerate(data):
            yield from flat(value, f"{at}[{i}]")
    else:
        yield at, data


@dataclass(frozen=True)
class Comparison:
    """Two runs beside each other."""

    keys: Table  # keys of the scene that differ
    numbers: Table  # numbers of result.json that differ, with B / A - 1
    # times, labels and columns of both trajectories; None unless both have one
    traces: tuple[list[str], np.ndarray, np.ndarray] | None


def compare(a: Path, b: Path) -> Comparison:
    """Which keys, numbers and trajectories of two runs differ. Raises SceneError: a folder holds no run."""
    results = []
    for folder in (a, b):
        if not (result := read_result(folder)):
            raise SceneError(f"{folder}: there is no result.json of a run in this folder; `softgrasp list` shows them")
        results.append(dict(flat(result)))
    files = [folder / "scene.toml" for folder in (a, b)]
    scenes = [dict(flat(tomllib.loads(file.read_text()) if file.exists() else {})) for file in files]
    names = list(dict.fromkeys([*scenes[0], *scenes[1]]))
    keys = [
        (name, *(str(s.get(name, "-")) for s in scenes)) for name in names if scenes[0].get(name) != scenes[1].get(name)
    ]
    numbers = []
    for name, x in results[0].items():
        y: Any = results[1].get(name)
        if type(x) in (int, float) and type(y) in (int, float):
            change = abs(y - x) / max(abs(x), abs(y)) if x != y else 0.0
            if change > ALIKE:
                numbers.append((name, x, y, y / x - 1 if x else None))
    heads = (str(a), str(b))
    return Comparison(
        Table(("key of the scene", *heads), keys), Table(("number", *heads, "B / A - 1"), numbers), _traces(a, b)
    )


def _traces(a: Path, b: Path) -> tuple[list[str], np.ndarray, np.ndarray] | None:
    """Shared columns of both trajectory.csv, time first and velocities left out."""
    tables = []
    for folder in (a, b):
        if not (folder / "trajectory.csv").exists():
            return None
        with (folder / "trajectory.csv").open(newline="") as file:
            header, *rows = csv.reader(file)
        tables.append((header, np.array(rows, dtype=float)))
    shared = [name for name in tables[0][0] if name in tables[1][0] and "/s]" not in name]
    columns = [rows[:, [header.index(name) for name in shared]] for header, rows in tables]
    return shared, columns[0], columns[1]


def apart(traces: tuple[list[str], np.ndarray, np.ndarray] | None) -> str:
    """How far two trajectories are from each other, in one sentence; nothing where there are not two."""
    if traces is None:
        return ""
    names, a, b = traces
    if a.shape != b.shape or not np.allclose(a[:, 0], b[:, 0]):
        return "The trajectories have other time steps; the picture shows both."
    most: dict[str, float] = {}
    for name, size in zip(names[1:], np.abs(a - b).max(axis=0)[1:], strict=True):
        unit = name.rpartition("[")[2].rstrip("]")
        most[unit] = max(most.get(unit, 0.0), float(size))
    return f"The trajectories differ by at most {' and '.join(f'{size:.2g} {unit}' for unit, size in most.items())}."


@folder_lock()
def run_compare(a: Path, b: Path, out: Path, console: Console, *, pictures: bool = True, empty: bool = False) -> None:
    """Print how two runs differ, and write compare.csv, result.json and a picture. Not collective.

    Raises SceneError: a folder holds no run, or the one to write into holds another.
    """
    comparison = compare(a, b)
    claim(out, "compare", f"{a.name} {b.name}", inputs=(a, b), empty=empty)
    keys, numbers = comparison.keys, comparison.numbers
    for table, none in ((keys, "The scenes are the same."), (numbers, "The numbers are the same.")):
        shown = Table(table.header, table.rows[:SHOWN]).terminal(wrap=(0, 1, 2), width=console.width)
        console.print(shown if table.rows else none)
    if len(numbers.rows) > SHOWN:
        console.print(f"{len(numbers.rows) - SHOWN} more numbers are in compare.csv")
    if distance := apart(comparison.traces):
        console.print(distance)
    result: dict[str, Any] = {"command": "compare", "scene": f"{a.name} {b.name}", "a": str(a), "b": str(b)}
    result |= {"keys": [list(row) for row in keys.rows], "numbers": [list(row) for row in numbers.rows]}
    files = [write_json(out / "result.json", result), numbers.write_csv(out / "compare.csv")]
    drawn: tuple[Path, ...] = ()
    if pictures and (comparison.traces is not None or numbers.rows):
        from softgrasp.study.runs.plots import figure_numbers, figure_two  # brings Matplotlib

        names, file = (a.name, b.name), out / "compare.png"
        traces = comparison.traces
        drawn = figure_numbers(numbers, names, file) if traces is None else figure_two(*traces, names, file)
    files += drawn
    first = [f"{name} is {x} in A and {y} in B" for name, x, y in keys.rows[:3]]
    page = write_report(
        out / "report.html",
        title=f"{a.name} (A) and {b.name} (B)",
        summary=[
            f"{counted(len(keys.rows), 'key')} and {counted(len(numbers.rows), 'number')} of the results differ.",
            f"{'; '.join(first) or 'The scenes are the same'}.",
            *([distance] if distance else []),
        ],
        sections=[
            Section("", figures=[(file, "A and B, and their difference.") for file in drawn[:1]]),
            *([keys.section(title="Keys of the scene")] if keys.rows else []),
            numbers.section(title="Numbers of result.json"),
        ],
        reproduce=command_line("compare", a, [], 1, f" {b}"),
        numbers="compare.csv and result.json",
        files=files,
    )
    list_files(console, [*files, page])
