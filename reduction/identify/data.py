"""Measured outputs over time, from a CSV file, and the noise of each."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from softgrasp.fem.columns import Array, Columns, labels
from softgrasp.fem.errors import SceneError, no_pipe, shortened

FEWEST = 8  # measured numbers; with fewer the noise cannot be estimated
FAR = 1000.0  # lengths of the body: a marker farther away has another unit
TURN = 4 * np.pi  # largest angle of an output [rad]: larger ones are degrees
TIMES = ("time [s]", "t [s]", "time", "t")


@dataclass(frozen=True)
class Measurements:
    """Outputs of one experiment at instants of their own."""

    name: str  # name of the file
    times: Array  # instants of the samples, increasing, (m,) [s]
    values: Array  # outputs in the order of the scene, nan where nothing was measured, (m, p) [m, rad]
    # measured hand: times (k,) [s] and positions (k, n_s) [m, rad]; None for the hand of the scene
    hand: tuple[Array, Array] | None = None

    @property
    def seen(self) -> np.ndarray:
        """Whether an output was measured at an instant, (m, p)."""
        return np.isfinite(self.values)


def read_measurements(path: Path, outputs: Columns, hand: Columns, end: float, size: float) -> Measurements:
    """Columns "time [s]", outputs "tip_x [m]" and perhaps the hand "q_x [m]"; empty cells are missing samples.

    Args:
        outputs: those of the scene.
        hand: degrees of freedom of the hand, by the name q.
        end: end of the scene's run [s].
        size: length of the body [m].

    Raises SceneError: in one sentence, with the line where there is one. Not collective.
    """
    try:
        with no_pipe(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: the measurements cannot be read ({getattr(error, 'strerror', error)})") from None
    rows = [(line, row) for line, row in rows if any(row)]
    head = rows[0][1] if rows else []
    columns = (*outputs, *hand)
    places = _places(path, head, columns)
    table = np.full((len(rows) - 1, 1 + len(columns)), np.nan)
    for i, (line, row) in enumerate(rows[1:]):
        if len(row) != len(head):
            raise SceneError(f"{path}: line {line} has {len(row)} cells; it must have {len(head)} as the first line")
        for j, cell in zip(places, row, strict=True):
            table[i, j] = _number(path, line, cell)
    p = len(outputs)
    times, moved = table[:, 0], table[:, 1 + p :]
    if np.isnan(times).any() or (np.diff(times) <= 0).any():
        line = rows[1 + int(np.flatnonzero(np.isnan(times) | (np.diff(times, prepend=-np.inf) <= 0))[0])][0]
        raise SceneError(f"{path}: line {line}: times must be given in each line and increase from line to line")
    measured = None
    if np.isfinite(moved).any():
        whole = np.isfinite(moved).all(axis=1)
        if whole.sum() < 2 or times[whole][0] > 0:
            raise SceneError(f"{path}: a measured hand must have all its positions at 0 s and at a later time")
        measured = times[whole], moved[whole]
        end = float(times[whole][-1])
    rows_seen = np.isfinite(table[:, 1 : 1 + p]).any(axis=1)
    result = Measurements(path.name, times[rows_seen], table[rows_seen, 1 : 1 + p], measured)
    check(str(path), result, end, size, outputs)
    return result


def _places(path: Path, head: Sequence[str], columns: Columns) -> list[int]:
    """Number of the column of the table for each column of the file; 0 is the time."""
    names = {name: 1 + i for i, c in enumerate(columns) for name in (c.label, f"{c.label} [{c.unit}]")}
    wanted = ", ".join(f"{c.label} [{c.unit}]" for c in columns)
    if not head or head[0] not in TIMES:
        raise SceneError(f"{path}: the first column must be 'time [s]'; those after it can be {wanted}")
    if wrong := next((name for name in head[1:] if name not in names), None):
        raise SceneError(f"{path}: '{shortened(wrong)}' is no output of the scene; the columns can be {wanted}")
    places = [names[name] for name in head[1:]]
    if len(set(places)) < len(places):
        raise SceneError(f"{path}: a column is given twice; the columns can be {wanted}")
    return [0, *places]


def _number(path: Path, line: int, cell: str) -> float:
    if not cell:
        return np.nan
    try:
        value = float(cell)
    except ValueError:
        raise SceneError(f"{path}: line {line}: '{shortened(cell)}' is no number") from None
    if not np.isfinite(value):
        raise SceneError(
            f"{path}: line {line}: '{shortened(cell)}' is not finite; leave the cell of a missing sample empty"
        )
    return value


def check(what: str, data: Measurements, end: float, size: float, outputs: Columns) -> None:
    """Refuse data that nothing can be identified from.

    Args:
        what: name of the data in the sentence.
        end: end of the hand's motion [s].
        size: length of the body [m].
        outputs: those of the scene, one for each column of ``data.values``.

    Raises SceneError: with one sentence.
    """
    seen, times = data.seen, data.times
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise SceneError(f"{what}: times must be finite and increase from one to the next")
    if np.isinf(data.values).any():
        raise SceneError(f"{what}: an output is infinite; a missing sample is nan")
    if seen.sum() < FEWEST:
        raise SceneError(f"{what}: {seen.sum()} measured numbers are too few; give at least {FEWEST}")
    if times[0] < 0 or times[-1] > end * (1 + 1e-9):
        raise SceneError(
            f"{what}: the times run from {times[0]:g} to {times[-1]:g} s, and the hand moves from 0 to {end:g} s"
        )
    for column, values in zip(outputs, data.values.T, strict=True):
        largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
        if column.rotation and largest > TURN:
            raise SceneError(f"{what}: {column.label} is {largest:.3g} rad, more than two turns; give radians")
        if not column.rotation and largest > FAR * size:
            raise SceneError(
                f"{what}: {column.label} is {largest:.3g} m, and the body is {size:.3g} m long; give metres"
            )
    moved = 0.0 if data.hand is None else float(np.abs(data.hand[1]).max())
    if moved > FAR * size:
        raise SceneError(f"{what}: the hand moves to {moved:.3g} m, and the body is {size:.3g} m long; give metres")
    low, high = (f(np.where(seen, data.values, s * np.inf), axis=0) for f, s in ((np.min, 1), (np.max, -1)))
    if not (high > low).any():
        raise SceneError(f"{what}: no output moves; nothing can be identified from constants")


def with_distinct_names(many: Sequence[Measurements]) -> tuple[Measurements, ...]:
    """The same data; a name that several have gets a number, "camera.csv (2)"."""
    names = [data.name for data in many]
    seen: dict[str, int] = {}
    result = []
    for data in many:
        seen[data.name] = seen.get(data.name, 0) + 1
        alone = names.count(data.name) == 1
        result.append(data if alone else replace(data, name=f"{data.name} ({seen[data.name]})"))
    return tuple(result)


def parse_noise(text: str, columns: Columns) -> Array:
    """Standard deviation of each output (p,) of "1e-3", or "tip=1e-3,mid_x=2e-3" [m, rad].

    Raises SceneError: a value is not positive, a name is no output, or an output has none.
    """
    result = np.full(len(columns), np.nan)
    for part in filter(None, (word.strip() for word in text.split(","))):
        name, equals, number = part.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value < np.inf:
            raise SceneError(
                f"--noise {shortened(part)}: it must be a standard deviation > 0, such as 1e-3, or tip=1e-3"
            )
        chosen = [not equals or name.strip() in (c.label, c.name) for c in columns]
        if not any(chosen):
            raise SceneError(f"--noise {shortened(part)}: the outputs of the scene are {', '.join(labels(columns))}")
        result[chosen] = value
    if np.isnan(result).any():
        without = [c.label for c, value in zip(columns, result, strict=True) if np.isnan(value)]
        raise SceneError(f"--noise {shortened(text)}: it gives none for {', '.join(without)}")
    return result


def interpolation(times: Array, dt: float, steps: int) -> csr_array:
    """Weights W of cubic Lagrange interpolation, y(times) = W y_n, sparse (m, steps + 1); constant beyond the ends."""
    count = min(4, steps + 1)
    at = np.clip(times / dt, 0, steps)
    first = np.clip(np.floor(at + 1e-9).astype(int) - 1, 0, steps + 1 - count)
    j = np.arange(count)
    weights = np.ones((len(times), count))
    for k in j:
        factor = (at - first - k)[:, None] / np.where(j == k, 1, j - k)
        weights *= np.where(j == k, 1.0, factor)
    rows = np.repeat(np.arange(len(times)), count)
    return csr_array((weights.ravel(), (rows, (first[:, None] + j).ravel())), shape=(len(times), steps + 1))
