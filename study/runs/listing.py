"""``softgrasp list`` and ``softgrasp compare``: what lies in folders of runs, and how two of them differ."""

from __future__ import annotations

import csv
import re
import shlex
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from softgrasp.fem import SceneError, counted, no_pipe, parse_toml, read_text
from softgrasp.fem.errors import shortened
from softgrasp.fem.scene.text import LARGEST
from softgrasp.study.report import Page, Section, Table, in_words
from softgrasp.study.shell import Session, folder_lock, read_result

ALIKE = 1e-12  # relative difference below which two numbers count as equal: rounding
COST = re.compile(
    r"(^|[._])(time(?!_error|_step)|seconds|memory)"
)  # names of times and memory, which differ from run to run
LONGEST = 6  # entries of a list that is compared entry by entry
LIST_WIDTH = 200  # [letters]
MOST_KEYS = 3  # of a run that are listed with their values
FOREIGN = 5  # files that a list of runs leaves out by name


def show_runs(folder: Path, console: Console) -> None:
    """Print the runs below a folder, and which files are none. Not collective."""
    console.width = max(console.width, LIST_WIDTH)  # a narrower terminal breaks the lines, but loses nothing
    runs, foreign = runs_below(folder)
    console.print(runs.terminal())
    for file in foreign[:FOREIGN]:
        console.print(f"left out: {file} is damaged or not of softgrasp", soft_wrap=True, markup=False)
    if len(foreign) > FOREIGN:
        console.print(f"and {len(foreign) - FOREIGN} more")


def runs_below(folder: Path) -> tuple[Table, list[Path]]:
    """One row a run, the newest last, and each ``result.json`` that is damaged or of another program.

    Raises SceneError: the folder does not exist.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder}: there is no such folder; runs write into out/SCENE-COMMAND or where --out says")
    header = ("folder", "command", "scene", "differs in", "n_e", "total [s]", "warnings", "ended")
    found, foreign, kinds = [], [], dict[tuple[str, str], list[dict[str, Any]]]()
    for file in folder.rglob("result.json"):
        if not (r := read_result(file.parent)):
            foreign.append(file)
            continue
        n_e, clock, warnings = r.get("n_e"), r.get("time"), r.get("warnings")
        seconds, ended = clock.get("total") if isinstance(clock, dict) else None, file.stat().st_mtime
        kind = str(r["command"]), str(r.get("scene", ""))
        try:
            keys = _whole(_scene(file.parent / "scene.toml"))
        except SceneError:
            keys = {}  # of a damaged scene, whose results are listed all the same
        kinds.setdefault(kind, []).append(keys)
        row = (
            str(file.parent), *kind, keys, n_e if _number(n_e) else None,
            seconds if _number(seconds) else None, len(warnings) if isinstance(warnings, list) else 0,
            time.strftime("%Y-%m-%d %H:%M", time.localtime(ended)),
        )  # fmt: skip
        found.append((ended, row))
    varied = {kind: _varied(scenes) for kind, scenes in kinds.items()}
    rows = [(*row[:3], _values(row[3], varied[row[1], row[2]]), *row[4:]) for _, row in sorted(found, key=_when)]
    return Table(header, rows), sorted(foreign)


def _when(found: tuple[float, Any]) -> float:
    return found[0]


def _whole(keys: dict[str, Any]) -> dict[str, Any]:
    """Flat keys with lists of numbers as one value each."""
    whole: dict[str, Any] = {}
    for name, value in keys.items():
        base = re.sub(r"\[\d+\]$", "", name)
        whole[base] = value if base == name else [*whole.get(base, []), value]
    return whole


def _varied(scenes: Sequence[dict[str, Any]]) -> list[str]:
    """Keys that not all runs of a scene have alike, without its description."""
    names = dict.fromkeys(name for keys in scenes for name in keys if name != "description")
    return [name for name in names if any(keys.get(name) != scenes[0].get(name) for keys in scenes)]


def _values(keys: dict[str, Any], varied: Sequence[str]) -> str:
    """Some of the keys that vary, with their values in one run: "material.mu = 35"."""
    words = [f"{'.'.join(name.split('.')[-2:])} = {shortened(f'{keys[name]}')}" for name in varied if name in keys]
    return ", ".join(words[:MOST_KEYS]) + (f", {len(words) - MOST_KEYS} more" if len(words) > MOST_KEYS else "")


def _number(value: Any) -> bool:
    """Whether it is a number that a table can show."""
    return type(value) in (int, float) and abs(value) < LARGEST


def flat(data: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables, pair by pair; short lists entry by entry."""
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
            what = "contains no result of softgrasp" if (folder / "result.json").exists() else "is not there"
            raise SceneError(f"{folder}/result.json {what}; name folders that `softgrasp list` prints")
        results.append(_flat(folder / "result.json", result))
    scenes = [_scene(folder / "scene.toml") for folder in (a, b)]
    names = list(dict.fromkeys([*scenes[0], *scenes[1]]))
    keys = [
        (name, *(str(s.get(name, "-")) for s in scenes)) for name in names if scenes[0].get(name) != scenes[1].get(name)
    ]
    numbers = []
    for name, x in results[0].items():
        y: Any = results[1].get(name)
        if _number(x) and _number(y):
            change = abs(y - x) / max(abs(x), abs(y)) if x != y else 0.0
            if change > ALIKE:
                numbers.append((name, x, y, y / x - 1 if x else None))
    numbers.sort(key=lambda row: COST.search(row[0]) is not None)  # stable: the others keep their order
    heads = (str(a), str(b))
    return Comparison(
        Table(("key of the scene", *heads), keys), Table(("number", *heads, "B / A - 1"), numbers), _traces(a, b)
    )


def _flat(file: Path, data: dict[str, Any]) -> dict[str, Any]:
    try:
        return dict(flat(data))
    except RecursionError:
        raise SceneError(f"{file} has too many nested brackets; run the scene again") from None


def _scene(file: Path) -> dict[str, Any]:
    """The keys of a scene; none where there is no file. Raises SceneError: it is damaged."""
    if not file.exists():
        return {}
    try:
        return _flat(file, parse_toml(read_text(file)))
    except OSError as error:
        raise SceneError(f"{file} cannot be read ({error.strerror}); run the scene again") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{file} is damaged ({error}); run the scene again") from None
    except ValueError as error:
        raise SceneError(f"{file} {error}; run the scene again") from None


def _traces(a: Path, b: Path) -> tuple[list[str], np.ndarray, np.ndarray] | None:
    """Labels, and rows of both runs, of the columns that both trajectory.csv have: time first, no velocities."""
    tables = []
    for folder in (a, b):
        if not (folder / "trajectory.csv").exists():
            return None
        tables.append(_trajectory(folder / "trajectory.csv"))
    shared = [name for name in tables[0][0] if name in tables[1][0] and "/s]" not in name]
    columns = [rows[:, [header.index(name) for name in shared]] for header, rows in tables]
    return shared, columns[0], columns[1]


def _trajectory(file: Path) -> tuple[list[str], np.ndarray]:
    """Labels and numbers of a table. Raises SceneError: it is damaged."""
    try:
        with no_pipe(file).open(newline="", encoding="utf-8") as lines:
            header, *cells = csv.reader(lines)
        rows = np.array(cells, dtype=float)
        good = header[:1] == ["t [s]"] and rows.shape == (len(cells), len(header)) and len(rows) > 0
        if good:
            known = np.abs(rows) < LARGEST
            known[0, [name.startswith("force") for name in header]] = True  # a force is of the step that ends there
            good = bool(known.all() and (np.diff(rows[:, 0]) > 0).all())
    except OSError as error:
        raise SceneError(f"{file} cannot be read ({error.strerror}); run the scene again") from None
    except (ValueError, csv.Error):
        good = False
    if not good:
        raise SceneError(f"{file} is damaged: it is no table of finite numbers with growing times; run the scene again")
    return header, rows


def apart(traces: tuple[list[str], np.ndarray, np.ndarray] | None) -> str:
    """How far two trajectories are from each other, in one sentence; nothing where there are not two."""
    if traces is None:
        return ""
    names, a, b = traces
    if a.shape != b.shape or not np.allclose(a[:, 0], b[:, 0]):
        return "The trajectories have different time steps; the picture shows both."
    most: dict[str, float] = {}
    for name, size in zip(names[1:], np.nanmax(np.abs(a - b), axis=0)[1:], strict=True):
        unit = name.rpartition("[")[2].rstrip("]")
        most[unit] = max(most.get(unit, 0.0), float(size))
    return f"The trajectories differ by at most {in_words([f'{size:.2g} {unit}' for unit, size in most.items()])}."


@folder_lock()
def run_compare(a: Path, b: Path, out: Path, console: Console, *, pictures: bool = True, empty: bool = False) -> None:
    """Print how two runs differ, and write compare.csv, result.json, a picture and a page. Collective.

    Raises SceneError: a folder holds no run, or the one to write into holds another.
    """
    comparison, name = compare(a, b), f"{a.name} {b.name}"
    session = Session("compare", a, (), out, console, pictures=pictures, empty=empty)
    session.claim(name, lambda: (a, b))
    keys, numbers = comparison.keys, comparison.numbers
    result: dict[str, Any] = {"command": "compare", "scene": name, "a": str(a), "b": str(b)}
    result |= {"keys": [list(row) for row in keys.rows], "numbers": [list(row) for row in numbers.rows]}
    session.write(None, result, lambda: compose(comparison, session, b), clock=False)


def compose(comparison: Comparison, session: Session, b: Path) -> Page:
    """Draw the picture and compose the page."""
    keys, numbers, traces, a = comparison.keys, comparison.numbers, comparison.traces, session.path
    drawn: tuple[Path, ...] = ()
    if session.pictures and (traces is not None or numbers.rows):
        from softgrasp.study.runs.plots import figure_numbers, figure_two  # brings Matplotlib

        names, file = (a.name, b.name), session.out / "compare.png"
        drawn = figure_numbers(numbers, names, file) if traces is None else figure_two(*traces, names, file)
    first = [f"{name} is {x} in A and {y} in B" for name, x, y in keys.rows[:3]]
    costs = sum(COST.search(row[0]) is not None for row in numbers.rows)
    found = f"{counted(len(keys.rows), 'key')} and {counted(len(numbers.rows) - costs, 'number')} of the results differ"
    found += f", and {counted(costs, 'time or size of memory', 'times and sizes of memory')}." if costs else "."
    parts = [
        Section("", figures=[(file, "A and B, and their difference.") for file in drawn[:1]]),
        *([keys.section(title="Keys of the scene", terminal=True)] if keys.rows else []),
        *([numbers.section(title="Numbers of result.json", terminal=True)] if numbers.rows else []),
    ]
    return Page(
        f"{a.name} (A) and {b.name} (B)",
        [found, f"{'; '.join(first) or 'The scenes are the same'}.", *filter(None, [apart(traces)])],
        parts, {"compare.csv": numbers}, drawn, f" {shlex.quote(str(b))}",
    )  # fmt: skip
