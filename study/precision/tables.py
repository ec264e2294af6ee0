"""Tables of ``softgrasp study`` about the full model, reduced models and slopes, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softgrasp.reduction.registry import METHODS
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.precision.fit import Slope, pareto
from softgrasp.study.precision.points import WorkPoint
from softgrasp.study.precision.riccati import TITLES as METHOD_TITLES

FORWARD_HEADER = (
    "setting",
    "unknowns",
    "error",
    "displacement",
    "assembly [s]",
    "factor [s]",
    "step [us]",
    "run [s]",
    "front",
)
REDUCED_HEADER = (
    "setting", "N", "error", "state error", "error with the mesh", "online [s]", "from nothing [s]", "front",
)  # fmt: skip


def error_text(point: WorkPoint) -> float | str:
    """The error, or below what it is where that of the reference is the larger one. Not collective."""
    low, high = point.details["error_range"]
    return f"< {high:.2g}" if low == 0 and np.isfinite(high) else point.error


def forward_rows(points: Sequence[WorkPoint], front_only: bool = False) -> list[tuple[Any, ...]]:
    """Rows under ``FORWARD_HEADER``. Not collective."""
    front, rows = pareto(points), []
    for p in front if front_only else points:
        d = p.details
        numbers = (d["assembly"], d["factor"], 1e6 * d["per_step"], p.seconds)
        rows.append((p.label, d["n_e"], error_text(p), d["error_displacement"], *numbers, "*" if p in front else ""))
    return rows


def reduced_rows(points: Sequence[WorkPoint], front_only: bool = False) -> list[tuple[Any, ...]]:
    """Rows under ``REDUCED_HEADER``; the front is that of the error against the own full run. Not collective."""
    front = own_front(points)
    rows = []
    for p in sorted(front, key=lambda p: p.seconds) if front_only else points:
        d = p.details
        name = METHODS[p.series].title if p.series in METHODS else p.series
        mark = "*" if p in front else "" if p.ok else "unstable"
        rows.append(
            (name, d["N"], d["error_outputs_full"], d["error_full"], error_text(p), p.seconds, d["scratch"], mark)
        )
    return rows


def own_front(points: Sequence[WorkPoint]) -> list[WorkPoint]:
    """Front of the error against the full run on the same mesh and steps against online time. Not collective."""
    moved = {
        id(p): WorkPoint(p.question, p.series, p.label, p.seconds, p.details["error_outputs_full"], p.ok)
        for p in points
    }
    front = pareto(list(moved.values()))
    return [p for p in points if moved[id(p)] in front]


def slope_rows(slopes: Sequence[Slope]) -> list[tuple[Any, ...]]:
    """Question, series, what against what, power, points. Not collective."""
    names: dict[str, dict[str, str]] = {
        "reduced": {key: method.title for key, method in METHODS.items()},
        "riccati": METHOD_TITLES,
        "reduced_riccati": BASIS_TITLES,
    }
    return [
        (s.question.replace("_", " "), names.get(s.question, {}).get(s.series, s.series), s.against,
         f"{s.power:+.2f}", s.count)
        for s in slopes
    ]  # fmt: skip
